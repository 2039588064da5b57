"""What an operator may order of a running world: the team's commands here, the plant's as a question to the plant."""

from __future__ import annotations

from collections.abc import Mapping

from marl_sched.comms.membership.slots import Membership, SlotState
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.answers import ANSWERS_PER_AGENT, Allowance
from marl_sched.errors import InvalidMessageError


class Commands:
    """Reads orders, at a bounded rate, and carries out those that are about the team.

    Attributes:
        paused_at: since when time stands still because somebody said so, None if it does not.
        drained: agents that are not asked any more.
    """

    def __init__(self, members: Membership, run: str, epoch: str, now: float) -> None:
        self.paused_at: float | None = None
        self.drained: set[int] = set()
        self._members, self._run, self._epoch = members, run, epoch
        self._allowance = Allowance(ANSWERS_PER_AGENT, now)

    def take(self, event: ev.Queried, now: float) -> list[ev.Effect]:
        """What to do about a query by `world/command`."""
        if not self._allowance.take(now):
            return [ev.Count("unanswered")]
        try:
            order = wire.decode(event.payload, wire.Team, wire.Work, wire.Operator)
        except InvalidMessageError as error:
            return [ev.Count("unparsed"), ev.Warn("unparsed", f"dropped an order: {error}")]
        if order.run != self._run or order.epoch not in ("", self._epoch):
            return [ev.Count("other_epoch"), self.answer(event.query, order.request, "it is to another run or epoch")]
        if isinstance(order, wire.Team):
            reason = self._team(order, now)
            kept: list[ev.Effect] = [ev.Keep(order)] if reason is None else []
            return [*kept, self.answer(event.query, order.request, reason)]
        return [ev.Order(event.query, order)]

    def restore(self, order: wire.Team, now: float) -> None:
        """Let an order hold that an earlier epoch of the world took; barred agents are not among what it left."""
        if order.kind != "readmit" or order.agent in self.drained:
            self._team(order, now)

    def answer(self, query: int, request: str, reason: str | None) -> ev.Reply:
        """That an order is accepted, or why not."""
        us = {"run": self._run, "epoch": self._epoch, "request": request}
        return ev.Reply(query, wire.Accepted(**us) if reason is None else wire.Declined(**us, reason=reason[:400]))

    def _team(self, order: wire.Team, now: float) -> str | None:
        """Carry out an order about the team; why it is impossible, None if it was done."""
        if order.kind == "pause":
            self.paused_at = now if self.paused_at is None else self.paused_at
            return None
        if order.kind == "resume":
            self.paused_at = None
            return None
        if order.agent is None or order.agent >= len(self._members.slots):
            return f"{order.kind}: there is no agent {order.agent}"
        if order.kind == "drain":
            self.drained.add(order.agent)
            return None
        barred = self._members.slots[order.agent].state == SlotState.BARRED
        if not barred and order.agent not in self.drained:
            return f"readmit: nothing keeps agent {order.agent} from deciding"
        self.drained.discard(order.agent)
        if barred:
            self._members.pardon(order.agent)
        return None


WORDS: Mapping[str, type[wire.Message]] = {
    **dict.fromkeys(("pause", "resume", "drain", "readmit"), wire.Team),
    **dict.fromkeys(("add", "cancel", "repeat", "reprioritise"), wire.Work),
    **dict.fromkeys(("pin", "forbid", "force", "hold"), wire.Operator),
}
"""What can be ordered -> the message that says it."""

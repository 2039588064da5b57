"""How the world reads what agents say, and lets incarnations in or keeps them out."""

from __future__ import annotations

import math
from collections.abc import Mapping

from marl_sched.comms.membership.slots import Membership
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.errors import InvalidMessageError

REFUSAL_GAP = 0.1  # seconds between two refusals to one agent
REASONS: Mapping[wire.Why, str] = {
    "given_up": "this incarnation has been given up",
    "unknown": "the world does not count on this incarnation",
    "other_epoch": "it speaks to another epoch of the world",
    "taken": "another process decides for this agent",
    "barred": "too many of its turns in a row were waited for in vain, it is not asked for a while",
}


class Reception:
    """Reads hellos, heartbeats and decisions, and registers incarnations."""

    def __init__(self, members: Membership, agent_keys: keys.AgentKeys, run: str, epoch: str) -> None:
        self._members, self._keys, self._run, self._epoch = members, agent_keys, run, epoch
        self._refused_at: dict[int, float] = {}

    def read(self, event: ev.Received, now: float, out: list[ev.Effect]) -> wire.Decision | wire.FromAgent | None:
        """What an agent of this run says to this epoch, None for anything else, which is counted."""
        try:
            agent, leaf, _ = self._keys.parse(event.key)
            if agent >= len(self._members.slots) or leaf == "alive":
                raise InvalidMessageError(f"{event.key}: nothing is heard there")
        except InvalidMessageError as error:
            out += [ev.Count("unparsed"), ev.Warn("unparsed", f"dropped a message: {error}")]
            return None
        kinds = (wire.Decision,) if leaf == "decision" else (wire.Hello, wire.Beat, wire.Goodbye)
        try:
            said: wire.Decision | wire.FromAgent = wire.decode(event.payload, *kinds)
            if said.agent != agent:
                raise InvalidMessageError(f"{event.key}: speaks for agent {said.agent}")
        except InvalidMessageError as error:
            out += [ev.Count("unparsed"), ev.Warn("unparsed", f"dropped a message: {error}")]
            self._tell_other_version(agent, event.payload, now, out)
            return None
        if said.run == self._run and said.epoch == self._epoch:
            return said
        out.append(ev.Count("other_epoch"))
        if isinstance(said, wire.Hello | wire.Beat):
            self.fence(agent, said.incarnation, "other_epoch", now, out)
        return None

    def read_token(self, key: str, out: list[ev.Effect]) -> tuple[int, str] | None:
        """The agent and the incarnation whose token a key is, None for any other, which is counted."""
        try:
            agent, leaf, incarnation = self._keys.parse(key)
            if leaf != "alive" or agent >= len(self._members.slots):
                raise InvalidMessageError(f"{key}: not the token of an agent of this run")
        except InvalidMessageError as error:
            out += [ev.Count("unparsed"), ev.Warn("unparsed", f"dropped a token: {error}")]
            return None
        return agent, incarnation

    def _tell_other_version(self, agent: int, payload: bytes, now: float, out: list[ev.Effect]) -> None:
        version = wire.other_version(payload, wire.Hello, wire.Beat, wire.Decision)
        if version is None or not self._may_refuse(agent, now):
            return
        reason = f"this world speaks version {wire.VERSION} of the protocol, the agent said {version}"
        refused = wire.Refused(run=self._run, epoch=self._epoch, reason=reason)
        out.append(ev.Put(self._keys.turn(agent), refused, control=True))

    def greet(self, hello: wire.Hello, now: float, out: list[ev.Effect]) -> None:
        """Welcome an incarnation, or say why not."""
        slot = self._members.slots[hello.agent]
        if hello.incarnation != slot.incarnation:
            refusal = self._members.refusal(hello.agent, hello.incarnation)
            if refusal == "no_token":  # tokens travel apart from messages; it is welcomed when its token is seen
                slot.early = hello
                return
            if refusal is not None:
                self.fence(hello.agent, hello.incarnation, refusal, now, out)
                return
            slot.early = None
            self._members.register(hello.agent, hello.incarnation, hello.policy, now)
            out.append(ev.Note(hello.agent, "joined"))
        elif self._members.hear(hello.agent, now):
            out.append(ev.Note(hello.agent, "returned"))
        welcome = wire.Welcome(run=self._run, epoch=self._epoch, agent=hello.agent, incarnation=hello.incarnation)
        out.append(ev.Put(self._keys.turn(hello.agent), welcome, control=True))

    def beat(self, beat: wire.Beat, now: float, out: list[ev.Effect]) -> None:
        """Note that an incarnation lives, or tell it that the world does not count on it."""
        slot = self._members.slots[beat.agent]
        if beat.incarnation != slot.incarnation:
            self.fence(beat.agent, beat.incarnation, "unknown", now, out)
            return
        slot.counts = dict(beat.counts)
        if self._members.hear(beat.agent, now):
            out.append(ev.Note(beat.agent, "returned"))

    def _may_refuse(self, agent: int, now: float) -> bool:
        if agent >= len(self._members.slots) or now < self._refused_at.get(agent, -math.inf) + REFUSAL_GAP:
            return False
        self._refused_at[agent] = now
        return True

    def fence(self, agent: int, incarnation: str, why: wire.Why, now: float, out: list[ev.Effect]) -> None:
        """Tell an incarnation that the world does not count on it, at most every REFUSAL_GAP seconds."""
        out.append(ev.Count("fenced"))
        if self._may_refuse(agent, now):
            fenced = wire.Fenced(
                run=self._run, epoch=self._epoch, agent=agent, incarnation=incarnation, why=why, reason=REASONS[why]
            )
            out.append(ev.Put(self._keys.turn(agent), fenced, control=True))

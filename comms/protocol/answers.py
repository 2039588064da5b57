"""The world's answers to queries: the frame for everybody, and for an agent the state of the channels it may hear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.errors import InvalidMessageError

ANSWERS_PER_AGENT = 4  # snapshots that the world gives an agent per second, and frames per agent in all


class Allowance:
    """So many things per second, and at most a second's worth at once."""

    def __init__(self, rate: float, now: float) -> None:
        self._rate, self._left, self._at = rate, rate, now

    def take(self, now: float) -> bool:
        """Whether one more is allowed."""
        self._left = min(self._rate, self._left + (now - self._at) * self._rate)
        self._at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Answers:
    """Answers at a bounded rate: a flood of questions must not take the world's time, nor another agent's answers."""

    def __init__(self, frame: wire.Frame, channels: Sequence[Sequence[str]], now: float) -> None:
        self._frame, self._channels = frame, channels
        self._frames = Allowance(ANSWERS_PER_AGENT * max(len(channels), 8), now)
        self._snapshots = [Allowance(ANSWERS_PER_AGENT, now) for _ in channels]

    def answer(
        self, event: ev.Queried, now: float, *, tick: int, phase: wire.Phase, news: Mapping[str, wire.News]
    ) -> list[ev.Effect]:
        """What to do about a query; a query without a Reply is closed without an answer."""
        if event.key == keys.FRAME:
            return [ev.Reply(event.query, self._frame)] if self._frames.take(now) else [ev.Count("unanswered")]
        try:
            asked = wire.decode(event.payload, wire.SnapshotRequest)
            if event.key != keys.snapshot(asked.agent):  # by the key, access rules tell agents apart
                raise InvalidMessageError(f"{event.key[:60]}: nothing is answered there to agent {asked.agent}")
            if asked.agent >= len(self._channels):
                raise InvalidMessageError(f"{event.key[:60]}: there is no agent {asked.agent}")
        except InvalidMessageError as error:
            return [ev.Count("unparsed"), ev.Warn("unparsed", f"dropped a query: {error}")]
        if not self._snapshots[asked.agent].take(now):
            return [ev.Count("unanswered")]
        known = [news[channel] for channel in self._channels[asked.agent] if channel in news]
        run, epoch = self._frame.run, self._frame.epoch
        return [ev.Reply(event.query, wire.Snapshot(run=run, epoch=epoch, tick=tick, phase=phase, channels=known))]

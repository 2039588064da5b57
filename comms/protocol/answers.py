"""The world's answers to queries: the frame for everybody, and for an agent the state of the channels it may hear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.errors import InvalidMessageError

ANSWERS_PER_AGENT = 4  # queries that the world answers per agent and second, in all


class Answers:
    """Answers at a bounded rate: a flood of questions must not take the world's time."""

    def __init__(self, frame: wire.Frame, channels: Sequence[Sequence[str]], now: float) -> None:
        self._frame, self._channels = frame, channels
        self._rate = float(ANSWERS_PER_AGENT * max(len(channels), 8))
        self._allowance, self._allowance_at = self._rate, now

    def answer(
        self, event: ev.Queried, now: float, *, tick: int, phase: wire.Phase, news: Mapping[str, wire.News]
    ) -> list[ev.Effect]:
        """What to do about a query; a query without a Reply is closed without an answer."""
        self._allowance = min(self._rate, self._allowance + (now - self._allowance_at) * self._rate)
        self._allowance_at = now
        if self._allowance < 1:
            return [ev.Count("unanswered")]
        self._allowance -= 1
        if event.key == keys.FRAME:
            return [ev.Reply(event.query, self._frame)]
        try:
            if event.key != keys.SNAPSHOT:
                raise InvalidMessageError(f"{event.key[:60]}: nothing is answered there")
            asked = wire.decode(event.payload, wire.SnapshotRequest)
        except InvalidMessageError as error:
            return [ev.Count("unparsed"), ev.Warn("unparsed", f"dropped a query: {error}")]
        channels = self._channels[asked.agent] if asked.agent < len(self._channels) else ()
        known = [news[channel] for channel in channels if channel in news]
        run, epoch = self._frame.run, self._frame.epoch
        return [ev.Reply(event.query, wire.Snapshot(run=run, epoch=epoch, tick=tick, phase=phase, channels=known))]

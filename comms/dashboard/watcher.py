"""What an observer knows of a run, gathered from the messages that the world sends observers."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.events import Received
from marl_sched.comms.transport.base import Transport
from marl_sched.errors import DeploymentError, InvalidMessageError

LANE = 300  # decisions of an agent that are kept
RATE_S = 5.0  # seconds over which decisions per second are counted
POLL = 0.2
CONFLICTS = ("conflict", "illegal", "lapsed")


@dataclass
class RunState:
    """What was heard so far; `hear` takes in a message, `as_dict` tells all of it.

    Attributes:
        newest: the last message, None before the first.
        heard_at: when it came, on the clock of `hear`.
        lanes: agent -> its newest decisions, as (tick, action, outcome).
        conflicts: choices that came to nothing since the observer came.
        unreadable: messages that were none.
    """

    newest: wire.Observed | None = None
    heard_at: float = 0.0
    lanes: list[deque[tuple[int, int, str]]] = field(default_factory=list)
    conflicts: int = 0
    unreadable: int = 0
    _counted: deque[tuple[float, str, int]] = field(default_factory=deque)

    def hear(self, payload: bytes, now: float) -> None:
        """Take in what the world said."""
        try:
            said = wire.decode(payload, wire.Observed)
        except InvalidMessageError:
            self.unreadable += 1
            return
        if self.newest is None or len(said.agents) != len(self.lanes):
            self.lanes = [deque(maxlen=LANE) for _ in said.agents]
        for one in said.decided:
            if one.agent < len(self.lanes):
                self.lanes[one.agent].append((one.tick, one.action, one.outcome))
            self.conflicts += one.outcome in CONFLICTS
        self.newest, self.heard_at = said, now
        self._counted.append((now, said.epoch, said.decisions))
        while self._counted[0][0] < now - RATE_S or self._counted[0][1] != said.epoch:
            self._counted.popleft()

    def rate(self) -> float:
        """Decisions per second in the last RATE_S seconds."""
        (began, _, before), (ended, _, after) = self._counted[0], self._counted[-1]
        return (after - before) / (ended - began) if ended > began else 0.0

    def as_dict(self, now: float) -> dict[str, Any]:
        """All of it, ready for JSON; `{"phase": "waiting"}` before the first message."""
        said = self.newest
        if said is None:
            return {"phase": "waiting", "unreadable": self.unreadable}
        return {
            "run": said.run,
            "epoch": said.epoch,
            "phase": said.phase,
            "tick": said.tick,
            "horizon": said.horizon,
            "unit": said.unit,
            "silent_s": round(now - self.heard_at, 2),
            "decisions": said.decisions,
            "decisions_per_s": round(self.rate(), 1),
            "conflicts": self.conflicts,
            "objectives": said.objectives,
            "counts": said.counts,
            "last_error": said.last_error,
            "agents": [
                {
                    "name": agent.name,
                    "state": agent.state,
                    "policy": agent.policy,
                    "turns": agent.turns,
                    "losses": agent.losses,
                    "silent_s": round(agent.silent, 2),
                    "lane": list(lane),
                }
                for agent, lane in zip(said.agents, self.lanes, strict=True)
            ],
        }


class Watcher:
    """A thread that listens to a run and keeps its RunState; use it as a context manager.

    `changed` is notified whenever a message came.
    """

    def __init__(self, connect: Callable[[], Transport], clock: Callable[[], float] = time.monotonic) -> None:
        """`connect` opens an observer's session, or raises DeploymentError while there is no world."""
        self._connect, self._clock = connect, clock
        self._state = RunState()
        self.changed = threading.Condition()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def __enter__(self) -> Watcher:
        """Begin to listen."""
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Leave."""
        self._ended.set()
        self._thread.join()
        with self.changed:
            self.changed.notify_all()

    @property
    def ended(self) -> bool:
        """Whether nobody listens any more."""
        return self._ended.is_set()

    def state(self) -> dict[str, Any]:
        """What is known now; see RunState.as_dict."""
        with self.changed:
            return self._state.as_dict(self._clock())

    def _listen(self) -> None:
        transport = self._opened()
        if transport is None:
            return
        try:
            transport.subscribe(keys.OBSERVED)
            while not self._ended.is_set():
                event = transport.receive(POLL)
                if isinstance(event, Received):
                    with self.changed:
                        self._state.hear(event.payload, self._clock())
                        self.changed.notify_all()
        finally:
            transport.close()

    def _opened(self) -> Transport | None:
        while not self._ended.is_set():
            try:
                return self._connect()
            except DeploymentError:  # not there yet, which the state says: waiting
                self._ended.wait(POLL)
        return None

"""An agent process: it hears what its view lets it hear, keeps its local_state, and decides when it is its turn.

By hand: `python -m marl_sched.comms.agent '{"agent": 3, "policy": "condition"}'`, or `marl-sched agent`.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from typing import Any

import numpy as np

from marl_sched.agents.base import ObservationScheduler
from marl_sched.agents.registry import create_scheduler
from marl_sched.comms import messages as wire
from marl_sched.comms.options import AgentOptions
from marl_sched.comms.process import run_process
from marl_sched.comms.session import Event, Transport, spoke
from marl_sched.domain import Domain, LocalState, get_domain
from marl_sched.errors import DeploymentError, InvalidMessageError, InvalidOptionError

log = logging.getLogger(__name__)
RETRY = 0.2  # seconds between two hellos, or two questions
ANSWER = 1.0  # seconds that an answer may take
HEARTBEAT = 1.0  # seconds after which a joined agent says hello again, and learns whether it is still counted on
REFUSED = 5.0  # seconds for which a refusal is not final: the seat's last process may just be dying


class Agent:
    """One agent of a run; `subscriptions` is all that it hears: the clock, its turns, and its view's channels.

    Raises DeploymentError when there is no world or it does not want this agent, InvalidOptionError when the
    agent does not exist or its policy needs more than an observation.
    """

    def __init__(self, options: AgentOptions, transport: Transport) -> None:
        self.options, self.transport = options, transport
        self.agent = options.agent
        self.counts: Counter[str] = Counter()
        self.subscriptions: set[str] = set()
        self._versions: dict[str, int] = {}
        self._turn: wire.Turn | None = None  # the one to answer, once the local state is up to date
        self._sent: wire.Decision | None = None
        self._incarnation = ""
        self._lost_at: float | None = None
        self._greeted_at = 0.0
        self._meet(self._ask_frame())
        self.scheduler = _load(options.policy, self.domain)

    def run(self) -> Counter[str]:
        """Decide until the run is over; counts of what was heard, decided and dropped."""
        self.transport.watch(wire.WORLD_ALIVE)
        over = self._join()
        while not over:
            over = self._handle(self.transport.receive(RETRY))
        return self.counts

    def _meet(self, frame: wire.Frame) -> None:
        """Know nothing but the frame, and listen to all that may be heard."""
        self.domain = get_domain(frame.env)
        self._keys = wire.AgentKeys(self.domain.agent_prefix)
        if self.agent >= frame.agents:
            raise InvalidOptionError(
                f"{self.domain.agent_name(self.agent)} does not exist: run {self.options.run!r} has "
                f"{self.domain.agent_name(0)} to {self.domain.agent_name(frame.agents - 1)}"
            )
        if self.domain.telemetry is None:
            raise DeploymentError(f"{frame.env} has no telemetry here: another version of this package?")
        self.local_state: LocalState = self.domain.telemetry.local_state(frame.problem, self.agent)
        self._versions, self._turn, self._sent = {}, None, None
        for key in (wire.CLOCK, self._keys.turn(self.agent), *self.local_state.channels):
            if key not in self.subscriptions:
                self.transport.subscribe(key)
                self.subscriptions.add(key)

    def _ask_frame(self) -> wire.Frame:
        return wire.decode(self._ask(wire.FRAME, b""), wire.Frame)

    def _ask(self, key: str, payload: bytes) -> bytes:
        """The world's answer. A question may be lost with the link that it was put to, so it is put again."""
        end = time.monotonic() + self.options.join_timeout
        while time.monotonic() < end:
            answer = self.transport.ask(key, payload, ANSWER)
            if answer is not None:
                return answer
            time.sleep(RETRY)
        raise DeploymentError(
            f"no world of run {self.options.run!r} at {self.options.connect} within {self.options.join_timeout:g} s"
        )

    def _join(self) -> bool:
        """Come in: catch up, warm up, announce, and say hello until welcomed; True if the run is over.

        The first decision of a policy is slow, so one is made before the world counts on this agent.
        """
        if self._catch_up():
            return True
        self.scheduler.choose(self.local_state.observe(), np.array([0.5]))
        self._incarnation = f"{time.time_ns():x}-{os.getpid():x}"
        self.transport.announce(self._keys.alive(self.agent, self._incarnation))
        self._lost_at = None
        end = time.monotonic() + self.options.join_timeout
        refusal = ""
        while time.monotonic() < end:
            self._greet()
            until = time.monotonic() + RETRY
            while (event := self.transport.receive(until - time.monotonic())) is not None:
                answer = self._hear(event)
                if isinstance(answer, wire.Clock) and answer.phase == "over":
                    return True
                if isinstance(answer, wire.Fenced):
                    end = end if refusal else min(end, time.monotonic() + REFUSED)
                    refusal = answer.reason
                elif isinstance(answer, wire.Welcome | wire.Turn):
                    if isinstance(answer, wire.Turn):
                        self._turn = answer
                        self._decide()
                    return False
        raise DeploymentError(
            f"{self.domain.agent_name(self.agent)} could not join: {refusal or 'no answer from the world'}"
        )

    def _rejoin(self) -> bool:
        """Come in again as a new incarnation that knows nothing; True if the run is over."""
        self.transport.withdraw(self._keys.alive(self.agent, self._incarnation))
        while self.transport.receive(0.0) is not None:
            self.counts["skipped"] += 1  # it was said to the last incarnation, the snapshot has what still holds
        self._meet(self._ask_frame())
        return self._join()

    def _greet(self) -> None:
        hello = wire.Hello(agent=self.agent, incarnation=self._incarnation, policy=self.options.policy)
        self.transport.put(self._keys.hello(self.agent), wire.encode(hello), reliable=True)
        self._greeted_at = time.monotonic()

    def _handle(self, event: Event | None) -> bool:
        """Take in an event and decide if that makes it possible; True when the run is over."""
        if time.monotonic() - self._greeted_at > HEARTBEAT:
            self._check_world()
            self._greet()
        if event is None:
            return False
        if event.kind == "gone":
            self._lost_at = time.monotonic()
            return False
        if event.kind == "alive":  # back again, perhaps as another run
            return self._lost_at is not None and self._rejoin()
        said = self._hear(event)
        if isinstance(said, wire.Clock):
            return said.phase == "over"
        if isinstance(said, wire.Fenced):
            return self._rejoin()
        if isinstance(said, wire.Turn):
            again = self._turn == said
            self._turn = said
            if again and self._lacks(said) and self._catch_up():
                return True
        self._decide()
        return False

    def _hear(self, event: Event) -> wire.Message | None:
        """The message to this agent that an event brought, None if it brought none or only telemetry."""
        if event.kind != "message":
            return None
        self.counts["heard"] += 1
        try:
            if event.key == wire.CLOCK:
                return wire.decode(event.payload, wire.Clock)
            if event.key == self._keys.turn(self.agent):
                said: wire.ToAgent = wire.decode(event.payload, wire.Turn, wire.Welcome, wire.Fenced)
                return said if said.incarnation == self._incarnation and said.agent == self.agent else None
            self._learn(event.key, wire.decode(event.payload, wire.News))
        except InvalidMessageError as error:
            self._drop(event.key, error)
        return None

    def _drop(self, key: str, error: InvalidMessageError) -> None:
        self.counts["unparsed"] += 1
        log.warning("dropped a message on %s: %s", key, error)

    def _learn(self, channel: str, news: wire.News) -> None:
        """Believe the news of a channel unless newer ones are known."""
        if news.sequence > self._versions.get(channel, 0):
            self.local_state.hear(channel, news.payload)
            self._versions[channel] = news.sequence

    def _catch_up(self) -> bool:
        """Ask for the newest state of all channels; True if the run is over."""
        request = wire.encode(wire.SnapshotRequest(agent=self.agent))
        snapshot = wire.decode(self._ask(wire.SNAPSHOT, request), wire.Snapshot)
        self.counts["snapshots"] += 1
        for channel, news in snapshot.channels.items():
            try:
                self._learn(channel, news)
            except InvalidMessageError as error:
                self._drop(f"{wire.SNAPSHOT}, {channel}", error)
        return snapshot.clock.phase == "over"

    def _lacks(self, turn: wire.Turn) -> bool:
        return any(self._versions.get(channel, 0) < sequence for channel, sequence in turn.needs.items())

    def _decide(self) -> None:
        """Answer the turn if there is one and the local state is exactly as up to date as it asks for."""
        turn = self._turn
        if turn is None or self._lacks(turn):
            return
        self._turn = None
        if any(self._versions[channel] > sequence for channel, sequence in turn.needs.items()):
            return  # the world has gone on without this decision
        if self._sent is None or self._sent.sequence != turn.sequence:
            target = int(self.scheduler.choose(self.local_state.observe(), np.array([turn.noise]))[0])
            self._sent = wire.Decision(
                tick=turn.tick, agent=self.agent, incarnation=turn.incarnation, sequence=turn.sequence, target=target
            )
            self.counts["decisions"] += 1
        self.transport.put(self._keys.decision(self.agent), wire.encode(self._sent), reliable=True)

    def _check_world(self) -> None:
        """End if the world has been gone for too long."""
        if self._lost_at is not None and time.monotonic() - self._lost_at > self.options.join_timeout:
            raise DeploymentError(f"the world at {self.options.connect} has gone")


def _load(policy: str, domain: Domain) -> ObservationScheduler:
    scheduler = create_scheduler(policy, domain)
    if not isinstance(scheduler, ObservationScheduler):
        raise InvalidOptionError(f"{policy} needs more than an agent's own observation and cannot be deployed")
    return scheduler


def run(options: AgentOptions, progress: Any = None) -> Counter[str]:
    """Be one agent of a run until it is over; see Agent for what it raises."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one decision is too small to share, and stays bit-equal
    with spoke(options.run, options.connect, options.join_timeout) as link:
        return Agent(options, link).run()


if __name__ == "__main__":
    run_process(AgentOptions, run)

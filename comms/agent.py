"""An agent process: it hears what its view lets it hear, keeps its belief, and decides when it is its turn.

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
from marl_sched.comms import messages as wire
from marl_sched.comms.options import AgentOptions
from marl_sched.comms.process import run_process
from marl_sched.comms.session import Event, Transport, spoke
from marl_sched.domain import Belief, Domain, get_domain
from marl_sched.errors import DeploymentError, InvalidMessageError, InvalidOptionError

log = logging.getLogger(__name__)
RETRY = 0.2  # seconds between two hellos, or two questions
HEARTBEAT = 1.0  # seconds after which a joined agent says hello again, and learns whether it is still counted on
REFUSED = 5.0  # seconds for which a refusal is not final: the seat's last process may just be dying


class Agent:
    """One agent of a run; `channels` is all that it hears besides the clock and its own turns.

    Raises DeploymentError when there is no world or it does not want this agent, InvalidOptionError when the
    agent does not exist or its policy needs more than an observation.
    """

    def __init__(self, options: AgentOptions, transport: Transport) -> None:
        self.options, self.transport = options, transport
        self.agent = options.agent
        self.counts: Counter[str] = Counter()
        self._versions: dict[str, int] = {}
        self._turn: wire.Turn | None = None  # the one to answer, once the belief is up to date
        self._sent: wire.Decision | None = None
        self._incarnation = ""
        self._lost_at: float | None = None
        self._greeted_at = 0.0
        frame = self._ask_frame()
        self.domain: Domain = get_domain(frame.env)
        if self.agent >= frame.agents:
            raise InvalidOptionError(
                f"{self.domain.agent_name(self.agent)} does not exist: run {options.run!r} has "
                f"{self.domain.agent_name(0)} to {self.domain.agent_name(frame.agents - 1)}"
            )
        if self.domain.telemetry is None:
            raise DeploymentError(f"{frame.env} has no telemetry here: another version of this package?")
        self.belief: Belief = self.domain.telemetry.belief(frame.problem, self.agent)
        self.scheduler = _load(options.policy, self.domain)
        self._keys = wire.AgentKeys(self.domain.agent_prefix)

    @property
    def channels(self) -> tuple[str, ...]:
        """The telemetry that the agent's view allows."""
        return self.belief.channels

    def run(self) -> Counter[str]:
        """Decide until the run is over; counts of what was heard, decided and dropped."""
        for key in (wire.CLOCK, self._keys.turn(self.agent), *self.channels):
            self.transport.subscribe(key)
        self.transport.watch(wire.WORLD_ALIVE)
        over = self._join()
        while not over:
            over = self._handle(self.transport.receive(RETRY))
        return self.counts

    def _ask_frame(self) -> wire.Frame:
        end = time.monotonic() + self.options.join_timeout
        while time.monotonic() < end:
            answer = self.transport.ask(wire.FRAME, b"", RETRY * 5)
            if answer is not None:
                return wire.decode(answer, wire.Frame)
            time.sleep(RETRY)
        raise DeploymentError(
            f"no world of run {self.options.run!r} at {self.options.connect} within {self.options.join_timeout:g} s"
        )

    def _join(self) -> bool:
        """Come in as a new incarnation: catch up, warm up, announce, and say hello until welcomed; True if it is over.

        The first decision of a policy is slow, so one is made before the world counts on this agent.
        """
        if self._catch_up():
            return True
        self.scheduler.choose(self.belief.observe(), np.array([0.5]))
        if self._incarnation:
            self.transport.withdraw(self._keys.alive(self.agent, self._incarnation))
        self._incarnation = f"{time.time_ns():x}-{os.getpid():x}"
        self._turn = self._sent = None
        self.transport.announce(self._keys.alive(self.agent, self._incarnation))
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
        said = self._hear(event)
        if isinstance(said, wire.Clock):
            return said.phase == "over"
        if isinstance(said, wire.Fenced):
            return self._join()
        if isinstance(said, wire.Turn):
            again = self._turn == said
            self._turn = said
            if again and self._lacks() and self._catch_up():
                return True
        self._decide()
        return False

    def _hear(self, event: Event) -> wire.Message | None:
        """The message to this agent that an event brought, None if it brought none or only telemetry."""
        if event.kind == "stop":
            raise KeyboardInterrupt
        if event.kind in ("alive", "gone"):
            self._lost_at = None if event.kind == "alive" else time.monotonic()
            return None
        self.counts["heard"] += 1
        try:
            if event.key == wire.CLOCK:
                return wire.decode(event.payload, wire.Clock)
            if event.key == self._keys.turn(self.agent):
                said = wire.decode(event.payload, wire.Turn, wire.Welcome, wire.Fenced)
                return said if said.incarnation == self._incarnation and said.agent == self.agent else None
            self._learn(event.key, wire.decode(event.payload, wire.News))
        except InvalidMessageError as error:
            self.counts["unparsed"] += 1
            log.warning("dropped a message on %s: %s", event.key, error)
        return None

    def _learn(self, channel: str, news: wire.News) -> None:
        """Believe the news of a channel unless newer ones are known."""
        if news.sequence > self._versions.get(channel, 0):
            self.belief.hear(channel, news.payload)
            self._versions[channel] = news.sequence

    def _catch_up(self) -> bool:
        """Ask for the newest state of all channels; True if the run is over."""
        request = wire.encode(wire.SnapshotRequest(agent=self.agent))
        answer = self.transport.ask(wire.SNAPSHOT, request, self.options.join_timeout)
        if answer is None:
            raise DeploymentError(f"no snapshot from {self.options.connect} within {self.options.join_timeout:g} s")
        snapshot = wire.decode(answer, wire.Snapshot)
        self.counts["snapshots"] += 1
        for channel, news in snapshot.channels.items():
            self._learn(channel, news)
        return snapshot.clock.phase == "over"

    def _lacks(self) -> bool:
        assert self._turn is not None
        return any(self._versions.get(channel, 0) < sequence for channel, sequence in self._turn.needs.items())

    def _decide(self) -> None:
        """Answer the turn if there is one and the belief is exactly as up to date as it asks for."""
        turn = self._turn
        if turn is None or self._lacks():
            return
        self._turn = None
        if any(self._versions[channel] > sequence for channel, sequence in turn.needs.items()):
            return  # the world has gone on without this decision
        if self._sent is None or self._sent.sequence != turn.sequence:
            target = int(self.scheduler.choose(self.belief.observe(), np.array([turn.noise]))[0])
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
    from marl_sched.agents.airme_rules import RULES

    scheduler = RULES[policy]()
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

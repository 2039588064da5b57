"""An agent process: it hears what its view lets it hear, keeps its local state, and decides when it is its turn.

The protocol (`marl_sched.comms.protocol.agent_protocol`) decides what happens; this file carries it out.

By hand: `python -m marl_sched.comms.agent '{"agent": 3, "policy": "random"}'`, or `marl-sched agent`.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from marl_sched.agents.base import ObservationScheduler, Scheduler
from marl_sched.agents.recurrent import LocalAgent, RecurrentScheduler
from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.metrics.throttle import ThrottledLog
from marl_sched.comms.options import AgentOptions
from marl_sched.comms.process import interruptible, run_process
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.agent_protocol import AgentProtocol
from marl_sched.comms.protocol.rules import AgentRules
from marl_sched.comms.transport.base import Transport
from marl_sched.comms.transport.faulty import Faults, FaultyTransport
from marl_sched.domain import LocalState, get_domain
from marl_sched.errors import DeploymentError, InvalidMessageError, InvalidOptionError

log = logging.getLogger(__name__)


class PolicyMind:
    """A domain's local state and the policy that decides on it; see Mind."""

    def __init__(self, options: AgentOptions) -> None:
        self._options = options
        self._state: LocalState | None = None
        self._decider: Decider | None = None

    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        """See Mind.meet. Raises InvalidOptionError for an agent that does not exist or a policy that cannot decide."""
        domain = get_domain(frame.env)
        if self._options.agent >= frame.agents:
            raise InvalidOptionError(
                f"{domain.agent_name(self._options.agent)} does not exist: run {self._options.run!r} has "
                f"{domain.agent_name(0)} to {domain.agent_name(frame.agents - 1)}"
            )
        if domain.telemetry is None:
            raise DeploymentError(f"{frame.env} has no telemetry here: another version of this package?")
        try:
            self._state = domain.telemetry.local_state(frame.problem, self._options.agent)
        except InvalidMessageError as error:
            raise DeploymentError(f"the world's frame cannot be read: {error}") from error
        if self._decider is None:
            self._decider = decider_of(self._options.policy, domain)
        return domain.agent_prefix, self._state.channels

    def learn(self, channel: str, payload: bytes) -> None:
        """See Mind.learn."""
        self._known()[0].hear(channel, payload)

    def forget(self) -> bool:
        """See Mind.forget."""
        return self._known()[1].forget()

    def choose(self, noise: float) -> tuple[int, int | None]:
        """The policy's action, and how many decisions its memory held before it; None without a memory."""
        state, decider = self._known()
        return decider.choose(state, noise)

    def rehearse(self) -> None:
        """Decide once and forget it: the first decision of a policy is slow."""
        state, decider = self._known()
        decider.rehearse(state)

    def _known(self) -> tuple[LocalState, Decider]:
        if self._state is None or self._decider is None:
            raise RuntimeError("the world has not been met")
        return self._state, self._decider


class Agent:
    """One agent of a run, driven by a clock and a network.

    Attributes:
        protocol: what decides.
    """

    def __init__(
        self,
        options: AgentOptions,
        transport: Transport,
        *,
        rules: AgentRules | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.options, self.transport, self._clock = options, transport, clock
        self.mind = PolicyMind(options)
        self.protocol = AgentProtocol(
            rules or AgentRules(join=options.join_timeout, silence=max(4.0, 3 * options.lease)),
            run=options.run,
            agent=options.agent,
            policy=options.policy,
            identity=f"{time.time_ns():x}-{os.getpid():x}",
            mind=self.mind,
            now=clock(),
        )
        self._warnings = ThrottledLog(log)

    def run(self) -> Counter[str]:
        """Decide until the run is over; counts of what was heard, decided and dropped.

        Raises DeploymentError when there is no world or it does not want this agent, InvalidOptionError when the
        agent does not exist or its policy needs more than an observation.
        """
        self.handle(ev.Reopened())
        while self.protocol.ended is None:
            event = self.transport.receive(max(self.protocol.wake_at - self._clock(), 0.0))
            self.handle(ev.Wake() if event is None else event)
        if self.protocol.ended.ending == ev.Ending.FAILED:
            raise DeploymentError(f"agent {self.options.agent}: {self.protocol.ended.reason}")
        return self.protocol.counts

    def handle(self, event: ev.Event) -> None:
        """Give the protocol an event and carry out what it says, and what that brings about."""
        for effect in self.protocol.handle(event, self._clock()):
            match effect:
                case ev.Put(key, message, control):
                    self.transport.put(key, wire.encode(message), control=control)
                case ev.Ask(question, key, asked):
                    self.transport.ask(question, key, b"" if asked is None else wire.encode(asked))
                case ev.Choose(turn):
                    self.handle(ev.Chosen(turn.sequence, *self.mind.choose(turn.noise)))
                case ev.Announce(key):
                    self.mind.rehearse()  # before the world counts on it
                    self.transport.announce(key)
                case ev.Reopen():
                    self.transport.reopen()
                    self.handle(ev.Reopened())
                case ev.Subscribe(key):
                    self.transport.subscribe(key)
                case ev.Unsubscribe(key):
                    self.transport.unsubscribe(key)
                case ev.Watch(key):
                    self.transport.watch(key)
                case ev.Withdraw(key):
                    self.transport.withdraw(key)
                case ev.Warn(kind, text):
                    self._warnings.warn(kind, text, self._clock())


class Decider(Protocol):
    """Decides for one agent on what that was told."""

    def choose(self, state: LocalState, noise: float) -> tuple[int, int | None]:
        """The action, and how many decisions a memory held before it; None without a memory."""

    def forget(self) -> bool:
        """Begin with an empty memory, or without a plan; whether there is a memory at all."""

    def rehearse(self, state: LocalState) -> None:
        """Decide once and forget it."""


class PolicyDecider:
    """Decides by a policy on the agent's observation, with the agent's memory; see Decider."""

    def __init__(self, policy: ObservationScheduler | RecurrentScheduler) -> None:
        self._policy, self._agent = policy, LocalAgent(policy)

    def choose(self, state: LocalState, noise: float) -> tuple[int, int | None]:
        """See Decider.choose."""
        remembered = self._agent.remembered
        return self._agent.choose(state.observe(), noise), remembered

    def forget(self) -> bool:
        """See Decider.forget."""
        self._agent.reset()
        return self._agent.memory is not None

    def rehearse(self, state: LocalState) -> None:
        """See Decider.rehearse."""
        LocalAgent(self._policy).choose(state.observe(), 0.5)


class PlanDecider:
    """Plans for the whole team, each agent for itself, on what it was told as a simulator; see Decider."""

    def __init__(self, planner: Scheduler) -> None:
        self._planner, self._begun = planner, False

    def choose(self, state: LocalState, noise: float) -> tuple[int, int | None]:
        """See Decider.choose. InvalidOptionError where the view hides something."""
        simulator = state.simulator()
        if simulator is None:
            name = self._planner.name
            raise InvalidOptionError(f"{name} plans for the whole team: expected a view that hides nothing")
        if not self._begun:
            self._planner.start(simulator, np.ones(1, np.bool_))
            self._begun = True
        return int(self._planner.decide(simulator)[0]), None

    def forget(self) -> bool:
        """See Decider.forget."""
        self._begun = False
        return False

    def rehearse(self, state: LocalState) -> None:
        """See Decider.rehearse."""
        self.choose(state, 0.5)
        self.forget()


def decider_of(policy: str, domain: Any) -> Decider:
    """What decides by a policy on what one agent is told; InvalidOptionError for a policy that needs more."""
    scheduler = create_scheduler(policy, domain)
    if isinstance(scheduler, ObservationScheduler | RecurrentScheduler):
        return PolicyDecider(scheduler)
    if scheduler.plans_on_estimates:
        return PlanDecider(scheduler)
    raise InvalidOptionError(f"{policy} needs more than an agent is told and cannot be deployed")


def run(options: AgentOptions, progress: Any = None) -> Counter[str]:
    """Be one agent of a run until it is over; see Agent.run for what it raises. Signals end it with a goodbye."""
    from marl_sched.comms.security.refusals import log_warnings
    from marl_sched.comms.transport.zenoh_session import spoke

    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one decision is too small to share, and stays bit-equal
    log_warnings()
    identity = options.identity()
    transport: Transport = spoke(options.run, options.connect, options.join_timeout, options.lease, identity=identity)
    if options.faults:
        transport = FaultyTransport(transport, Faults.of(options.faults), options.agent + 1)
    try:
        with interruptible(transport):
            return Agent(options, transport).run()
    finally:
        transport.close()


if __name__ == "__main__":
    run_process(AgentOptions, run)

"""What an agent knows and how it decides: a domain's local state, and a rule, a policy or a planner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from marl_sched.agents.base import ObservationScheduler, Scheduler
from marl_sched.agents.light import create_light_scheduler
from marl_sched.agents.local_rule import LocalRule
from marl_sched.agents.recurrent import LocalAgent, RecurrentScheduler
from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.agent_options import AgentOptions
from marl_sched.comms.protocol import messages as wire
from marl_sched.domain import Domain, get_domain
from marl_sched.domain_parts import LocalState
from marl_sched.errors import DeploymentError, InvalidMessageError, InvalidOptionError
from marl_sched.light import LightDomain, Runtime, light_domain


class PolicyMind:
    """A domain's local state and the policy that decides on it; see Mind."""

    def __init__(self, options: AgentOptions) -> None:
        self._options = options
        self._state: LocalState | None = None
        self._decider: Decider | None = None

    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        """See Mind.meet. Raises InvalidOptionError for an agent that does not exist or a policy that cannot decide."""
        light = light_domain(frame.env) if self._options.runtime == "onnx" else None
        domain = light or get_domain(frame.env)
        if self._options.agent >= frame.agents:
            raise InvalidOptionError(
                f"{domain.agent_name(self._options.agent)} does not exist: run {self._options.run!r} has "
                f"{domain.agent_name(0)} to {domain.agent_name(frame.agents - 1)}"
            )
        try:
            self._state = _local_state(domain, frame.problem, self._options.agent)
        except InvalidMessageError as error:
            raise DeploymentError(f"the world's frame cannot be read: {error}") from error
        if self._decider is None:
            self._decider = decider_of(self._options.policy, domain, self._options.runtime)
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


class LocalRuleDecider:
    """Decides by a rule on what the agent was told; see Decider."""

    def __init__(self, rule: LocalRule) -> None:
        self._rule = rule

    def choose(self, state: LocalState, noise: float) -> tuple[int, int | None]:
        """See Decider.choose."""
        return self._rule.choose_locally(state), None

    def forget(self) -> bool:
        """See Decider.forget."""
        return False

    def rehearse(self, state: LocalState) -> None:
        """See Decider.rehearse."""
        self._rule.choose_locally(state)


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


def decider_of(policy: str, domain: Domain | LightDomain, runtime: Runtime = "torch") -> Decider:
    """What decides by a policy on what one agent is told; InvalidOptionError for a policy that needs more."""
    if isinstance(domain, LightDomain):
        return PolicyDecider(create_light_scheduler(policy, domain))
    scheduler = create_scheduler(policy, domain, runtime=runtime)
    if isinstance(scheduler, ObservationScheduler | RecurrentScheduler):
        return PolicyDecider(scheduler)
    if isinstance(scheduler, LocalRule):
        return LocalRuleDecider(scheduler)
    if scheduler.plans_on_estimates:
        return PlanDecider(scheduler)
    raise InvalidOptionError(f"{policy} needs more than an agent is told and cannot be deployed")


def _local_state(domain: Domain | LightDomain, frame: bytes, agent: int) -> LocalState:
    if isinstance(domain, LightDomain):
        return domain.local_state(frame, agent)
    if domain.telemetry is None:
        raise DeploymentError(f"{domain.name} has no telemetry here: another version of this package?")
    return domain.telemetry.local_state(frame, agent)

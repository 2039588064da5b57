"""Schedulers that plan ahead: several coming decisions at once, which are then taken turn by turn.

A plan is followed until it holds no longer, by default when it is spent or when the action that comes next is not legal
any more; then another one is made. There are two ways to plan:

- for the whole team, from the simulator (`TeamPlanner`, `SequencePlanner`), as a whole round or a sequence for
  each agent. Whoever needs the simulator cannot be deployed.
- every agent for itself, from what it sees (`AgentPlanner`). What is left of its plan is its memory, so it plays in a
  simulator, in evaluation and as a process like every other RecurrentScheduler, and an agent that is started again
  begins without a plan.

A policy in the mode `one_pass` plans one decision epoch: what the first agent saw decides for all that are free then
(marl_sched.agents.policies.network_policy).
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.agents.recurrent import Observation, RecurrentScheduler
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.simulation import TurnSimulator

P = TypeVar("P")
SPENT = -1  # in place of an action: the plan ends here


class TeamPlanner(Scheduler, Generic[P]):
    """Plans for all agents of an env, on the simulator, and takes their turns by the plan.

    Attributes:
        planned_at: int64 (B,), `progress` of the simulator when each env's plan was made.
    """

    def __init__(self) -> None:
        self.planned_at = np.empty(0, np.int64)
        self._plans: list[P | None] = []

    @abstractmethod
    def plan(self, simulator: Any, env_index: int) -> P:
        """A plan from where an env stands, whose acting agent comes first."""

    @abstractmethod
    def holds(self, simulator: Any, env_index: int, plan: P) -> bool:
        """Whether the plan can still be followed at this turn; if not, another one is made."""

    @abstractmethod
    def next_action(self, simulator: Any, env_index: int, plan: P) -> int:
        """What the acting agent does by the plan; 0 where it has to wait or the plan has nothing for it."""

    def revise(self, simulator: Any, env_index: int, plan: P) -> P:
        """The plan to go on with, asked at every turn at which an older one holds; by default the same."""
        return plan

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Forget the envs' plans; new ones are made at their next turns."""
        if len(self._plans) != simulator.batch:
            self._plans, self.planned_at = [None] * simulator.batch, np.zeros(simulator.batch, np.int64)
        for env_index in np.flatnonzero(envs):
            self._plans[env_index] = None

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,)."""
        actions, progress = np.zeros(simulator.batch, np.int64), simulator.progress
        for env_index in np.flatnonzero(simulator.acting >= 0).tolist():
            plan = self._plans[env_index]
            if plan is None or not self.holds(simulator, env_index, plan):
                self.planned_at[env_index] = progress[env_index]
                plan = self.plan(simulator, env_index)
            else:
                plan = self.revise(simulator, env_index, plan)
            self._plans[env_index] = plan
            actions[env_index] = self.next_action(simulator, env_index, plan)
        return actions


class SequencePlanner(TeamPlanner[dict[int, deque[int]]]):
    """A plan is a sequence of actions for every agent, one for each of its coming turns; `sequences` makes it.

    An env is planned anew when the acting agent's sequence is spent or its next action is not legal. Where the new plan
    has nothing legal for it either, the agent does nothing.
    """

    _legal: np.ndarray  # int8 (B, n_actions), at this turn

    @abstractmethod
    def sequences(self, simulator: Any, env_index: int) -> Mapping[int, Sequence[int]]:
        """Agent -> its coming actions."""

    def plan(self, simulator: Any, env_index: int) -> dict[int, deque[int]]:
        """What `sequences` says, to be taken from the left."""
        return {agent: deque(actions) for agent, actions in self.sequences(simulator, env_index).items()}

    def holds(self, simulator: Any, env_index: int, plan: dict[int, deque[int]]) -> bool:
        """Whether the acting agent has a next action, and it is legal."""
        ahead = plan.get(int(simulator.acting[env_index]))
        return bool(self._legal[env_index, ahead[0]]) if ahead else False

    def next_action(self, simulator: Any, env_index: int, plan: dict[int, deque[int]]) -> int:
        """The acting agent's next action, which leaves the plan."""
        if not self.holds(simulator, env_index, plan):
            return 0
        return plan[int(simulator.acting[env_index])].popleft()

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,)."""
        self._legal = simulator.legal()
        return super().decide(simulator)


class AgentPlanner(RecurrentScheduler):
    """Every agent plans its own coming decisions from what it sees, at most `memory_size` of them; see the page."""

    @abstractmethod
    def plan(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """The agents' coming actions, int64 (B, memory_size), SPENT from the end of a plan on.

        From batched observations and uniforms float64 (B,) in [0, 1).
        """

    def initial_memory(self, batch: int) -> np.ndarray:
        """No plan, float32 (batch, memory_size)."""
        return np.full((batch, self.memory_size), SPENT, np.float32)

    def choose_recurrent(
        self, observation: Observation, memory: np.ndarray, uniform: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The next actions of the agents' plans, made anew where they do not hold, and what is left of the plans."""
        plans = memory.astype(np.int64)
        legal = np.asarray(observation[ACTION_MASK]) != 0
        anew = ~_holds(plans, legal)
        if anew.any():
            made = self.plan({name: values[anew] for name, values in observation.items()}, uniform[anew])
            if made.shape != (int(anew.sum()), self.memory_size):
                expected = (int(anew.sum()), self.memory_size)
                raise InvalidOptionError(f"{self.name}: plan: expected actions of shape {expected}, got {made.shape}")
            plans[anew] = made
        actions = np.where(_holds(plans, legal), plans[:, 0], 0)
        left = np.full_like(plans, SPENT)
        left[:, :-1] = plans[:, 1:]
        return actions, left.astype(np.float32)


def _holds(plans: np.ndarray, legal: np.ndarray) -> np.ndarray:
    """Bool (B,), whether the first action of each plan, int64 (B, length), is there and legal, bool (B, n_actions)."""
    first = plans[:, 0]
    return (first != SPENT) & legal[np.arange(len(plans)), np.maximum(first, 0)]

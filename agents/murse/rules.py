"""Priority rules for MuRSE: each picks a task for the agent that is free, from what that agent sees.

A rule chooses among the tasks that its agent can start at once and waits when there is none. Which of several
free agents chooses first is the simulator's picking strategy; a rule that belongs to one names it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import msgspec
import numpy as np

from marl_sched.agents.base import EpochPlayer, ObservationScheduler, best_action
from marl_sched.agents.murse.dispatching import dispatched
from marl_sched.agents.murse.list_schedule import NO_DEADLINE_PRIORITY
from marl_sched.agents.murse.snapshot import as_murse, estimated_round
from marl_sched.agents.murse.traffic import Traffic
from marl_sched.agents.murse.whole_rounds import round_player
from marl_sched.envs.murse.graph import DEADLINE, EARLIEST_FINISH, EARLIEST_START, HAS_DEADLINE, WEIGHT
from marl_sched.envs.murse.rules import FIRST
from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]


def legal_tasks(observation: Observation) -> np.ndarray:
    """Bool (B, T), the actions that are legal, `wait` left out."""
    legal = np.asarray(observation["action_mask"]) > 0
    legal[:, 0] = False
    return legal


class PriorityRule(ObservationScheduler):
    """The startable task of the highest priority; `priority` maps task features (B, T, F) to float64 (B, T).

    `name` is that of the same rule in PRIORITY_RULES.
    """

    def __init__(self, name: str, priority: Callable[[np.ndarray], np.ndarray]) -> None:
        self.name, self._priority = name, priority

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer | None:
        """Plays whole rounds by the compiled rule, where the first free agent decides first and all is seen."""
        murse = as_murse(simulator)
        if murse.rules.picking != FIRST:
            return None
        return round_player(murse, lambda simulator, row: dispatched(estimated_round(simulator, row), self.name))

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,), ties to the lower index; `uniform` is not used."""
        tasks = np.asarray(observation["task"], np.float64)
        return best_action(self._priority(tasks), legal_tasks(observation) & (tasks[..., EARLIEST_START] <= 0))


def edf() -> PriorityRule:
    """Earliest deadline first (sections 3.5.2, 4.4.2 and 5.7.2); tasks without a deadline come last."""

    def priority(tasks: np.ndarray) -> np.ndarray:
        return -np.where(tasks[..., HAS_DEADLINE] > 0, tasks[..., DEADLINE], NO_DEADLINE_PRIORITY)

    return PriorityRule("edf", priority)


def hctf() -> PriorityRule:
    """Highest cost tardiness first: the task of the highest cost (section 4.4.4)."""
    return PriorityRule("hctf", lambda tasks: tasks[..., WEIGHT])


class RandomRule(ObservationScheduler):
    """Any legal task, all alike, whether it can start at once or not; waits only when there is none."""

    name = "random"
    samples = True

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,) by inverse distribution from `uniform` float64 (B,)."""
        legal = legal_tasks(observation)
        rank = np.floor(uniform * legal.sum(axis=1)).astype(np.int64)
        return np.asarray((legal.cumsum(axis=1) > rank[:, None]).argmax(axis=1), np.int64)


class Claim(msgspec.Struct, array_like=True, tag=True):
    """An agent has taken a task."""

    agent: int
    task: int
    time: int


class FirstClaim(ObservationScheduler):
    """Every agent claims the task that it can finish earliest and tells those who hear it; who claims first has it.

    The task need not be able to start at once. A claim is one message, whoever hears it.
    """

    name = "first-claim"

    def __init__(self) -> None:
        self.traffic = Traffic()

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Begin to count anew."""
        self.traffic.restart(as_murse(simulator), envs)

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,), ties to the lower index; `uniform` is not used."""
        return best_action(-np.asarray(observation["task"], np.float64)[..., EARLIEST_FINISH], legal_tasks(observation))

    def per_round(self) -> dict[str, np.ndarray]:
        """Messages and bytes."""
        return self.traffic.per_round()

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,), each claim counted."""
        actions = super().decide(simulator)
        for row in np.flatnonzero(actions):
            claim = Claim(int(simulator.acting[row]), int(actions[row]), int(simulator.time[row]))
            self.traffic.add(as_murse(simulator), int(row), 1, len(msgspec.msgpack.encode(claim)))
        return actions

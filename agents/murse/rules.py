"""Priority rules for MuRSE: each picks a task for the agent that is free, from what that agent sees.

A rule chooses among the tasks that its agent can start at once and waits when there is none. Which of several
free agents chooses first is the simulator's picking strategy; a rule that belongs to one names it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import msgspec
import numpy as np

from marl_sched.agents.base import ObservationScheduler, Scheduler, best_action
from marl_sched.agents.murse.list_schedule import NO_DEADLINE_PRIORITY
from marl_sched.agents.murse.snapshot import as_murse, estimated_round
from marl_sched.agents.murse.traffic import Traffic
from marl_sched.envs.murse.graph import DEADLINE, EARLIEST_FINISH, EARLIEST_START, HAS_DEADLINE, WEIGHT
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]


def legal_tasks(observation: Observation) -> np.ndarray:
    """Bool (B, T), the actions that are legal, `wait` left out."""
    legal = np.asarray(observation["action_mask"]) > 0
    legal[:, 0] = False
    return legal


class PriorityRule(ObservationScheduler):
    """The startable task of the highest priority; `priority` maps task features (B, T, F) to float64 (B, T)."""

    def __init__(self, name: str, priority: Callable[[np.ndarray], np.ndarray]) -> None:
        self.name, self._priority = name, priority

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


class EdfPublished(Scheduler):
    """The rule that the published code calls EDF: it does not look at deadlines.

    Of the tasks that can start now it takes the one with the smallest earliest finish for the chosen agent in the
    initial network: the time that its waits alone hold it back, everybody taking their shortest, plus the agent's
    duration. It belongs to the picking strategy `mean_unscheduled`.
    """

    name = "edf-published"
    needs = "all durations and waits"
    simulator_options = MappingProxyType({"picking": "mean_unscheduled"})

    def __init__(self) -> None:
        self._rounds, self._finish = np.empty(0, np.int64), np.empty((0, 0, 0))

    def start(self, simulator: TurnSimulator, rows: np.ndarray) -> None:
        """Forget the rows' initial networks."""
        if self._finish.shape != (simulator.batch, simulator.max_agents, simulator.max_actions):
            self._rounds = np.full(simulator.batch, -1)
            self._finish = np.zeros((simulator.batch, simulator.max_agents, simulator.max_actions))
        self._rounds[rows] = -1

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,)."""
        observation = simulator.observe(simulator.acting)
        self._look_at_new_rounds(as_murse(simulator))
        now = np.asarray(observation["task"])[..., EARLIEST_START] <= 0
        finish = self._finish[np.arange(simulator.batch), simulator.acting]
        return best_action(-finish, legal_tasks(observation) & now)

    def _look_at_new_rounds(self, simulator: MurseSimulator) -> None:
        rounds = simulator.state.rows["round"]
        for row in np.flatnonzero((simulator.acting >= 0) & (rounds != self._rounds)):
            self._rounds[row] = rounds[row]
            instance, durations = simulator.instances[row], estimated_round(simulator, int(row)).durations
            shortest = np.where(durations > 0, durations, np.iinfo(np.int64).max).min(axis=1)
            held = instance.earliest_finishes(durations) - shortest
            self._finish[row, : instance.n_agents, 1 : instance.n_tasks + 1] = (held[:, None] + durations).T


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

    def start(self, simulator: TurnSimulator, rows: np.ndarray) -> None:
        """Begin to count anew."""
        self.traffic.restart(as_murse(simulator), rows)

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

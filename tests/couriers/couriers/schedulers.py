"""Who decides: rules that need one courier's observation and nothing else."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from couriers.graph import JOB_FEATURES
from marl_sched.agents.base import ObservationScheduler, best_action
from marl_sched.agents.planning import SPENT, AgentPlanner


class Greedy(ObservationScheduler):
    """The nearest job that may be chosen, ties to the smallest slot."""

    name = "nearest"
    heeds_objective = False

    def choose(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,)."""
        open_jobs = np.asarray(observation["action_mask"]) > 0
        open_jobs[:, 0] = False
        return best_action(-JOB_FEATURES.read(observation["job"], "distance"), open_jobs)


class OldestFirst(ObservationScheduler):
    """The job that has waited longest."""

    name = "oldest-first"
    heeds_objective = False

    def choose(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,)."""
        open_jobs = np.asarray(observation["action_mask"]) > 0
        open_jobs[:, 0] = False
        return best_action(JOB_FEATURES.read(observation["job"], "waited"), open_jobs)


class Idle(ObservationScheduler):
    """Nobody does anything: the reference."""

    name = "idle"
    heeds_objective = False

    def choose(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,), all 0."""
        return np.zeros(len(observation["action_mask"]), np.int64)


class Itinerary(AgentPlanner):
    """Every courier plans its next jobs by itself, the nearest first, and plans anew when the next one is gone."""

    name = "itinerary"
    heeds_objective = False
    memory_size = 3  # jobs ahead, at most

    def plan(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Job slots int64 (B, 3), SPENT after the last."""
        open_jobs = np.asarray(observation["action_mask"]) > 0
        open_jobs[:, 0] = False
        distance = np.where(open_jobs, JOB_FEATURES.read(observation["job"], "distance"), np.inf)
        nearest = distance.argsort(axis=1, kind="stable")[:, : self.memory_size]
        return np.where(np.isfinite(np.take_along_axis(distance, nearest, axis=1)), nearest, SPENT)


SCHEDULERS = {"nearest": Greedy, "idle": Idle}

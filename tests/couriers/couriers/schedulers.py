"""Who decides: rules that need one courier's observation and nothing else."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from couriers.graph import JOB_FEATURES
from marl_sched.agents.base import ObservationScheduler, best_action


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


SCHEDULERS = {"nearest": Greedy, "idle": Idle}

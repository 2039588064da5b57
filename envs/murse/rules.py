"""The options of the MuRSE simulator as its kernels take them."""

from __future__ import annotations

from typing import NamedTuple

PLAN, ONLINE = 0, 1
MODES = ("plan", "online")
FIRST, MEAN_LEFT, LEAST_LEFT, MEAN_ALL = 0, 1, 2, 3
PICKING = ("first", "mean_unscheduled", "min_unscheduled", "mean_all")
MAKESPAN, WEIGHTED = 0, 1
OBJECTIVES = ("makespan", "weighted")
ROUND_REWARD, DECISION_REWARD, PUBLISHED_REWARD = 0, 1, 2
REWARDS = ("round", "decision", "published")


class Rules(NamedTuple):
    """What stays the same over an episode; see MurseSimulator for the options."""

    mode: int
    picking: int
    objective: int
    rewards: int
    multiplier: float
    divisor: float

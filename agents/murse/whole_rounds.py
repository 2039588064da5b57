"""Rounds played whole: where a schedule is known when a round begins, the detour through turns is left out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from marl_sched.agents.base import EpochPlayer
from marl_sched.agents.murse.problem import Plan
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.envs.murse.views import FullView


def round_player(simulator: MurseSimulator, plan: Callable[[MurseSimulator, int], Plan]) -> EpochPlayer | None:
    """Plays `plan(simulator, row)` as the whole round of every row; None where turns have to be taken.

    That is in `online` mode, where a plan is revised in between, and under views that hide something, whose visible
    share depends on the turn. Schedules and results are those of the turns.
    """
    if simulator.mode != "plan" or not isinstance(simulator.view, FullView):
        return None

    def play(count: int) -> tuple[float, int]:
        decisions = 0
        for row in np.flatnonzero(simulator.acting != NOBODY).tolist():
            found = plan(simulator, row)
            simulator.play_round(row, found.tasks, found.agents)
            decisions += len(found.tasks)
        return float(decisions), decisions

    return play

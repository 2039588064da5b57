"""The one loop in which a scheduler plays episodes on a simulator."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.simulation import TurnSimulator

Watcher = Callable[[TurnSimulator, int], None]
"""Called before each decision with the simulator and the number of the decision, from 0."""


def play(scheduler: Scheduler, simulator: TurnSimulator, watch: Watcher | None = None) -> TurnSimulator:
    """Play every env of a simulator from the start of its episode to the end; returns the simulator."""
    scheduler.start(simulator, np.ones(simulator.batch, np.bool_))
    number = 0
    while (simulator.acting >= 0).any():
        if watch is not None:
            watch(simulator, number)
        simulator.step(scheduler.decide(simulator))
        number += 1
    return simulator

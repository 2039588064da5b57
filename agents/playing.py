"""The one loop in which a scheduler plays episodes on a simulator."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.simulation import TurnSimulator

EPOCHS_AT_ONCE = 24  # between two looks of a watcher, where a scheduler plays decision epochs in compiled code


class Watcher(Protocol):
    """Who looks on while episodes are played."""

    def before(self, simulator: TurnSimulator, number: int) -> None:
        """Called before each decision, `number` counts them from 0."""

    def played(self, simulator: TurnSimulator, shares: float, decisions: int) -> None:
        """Called after decisions in compiled code: how many, and the sum of the visible shares of some of them."""


def play(
    scheduler: Scheduler, simulator: TurnSimulator, watcher: Watcher | None = None, *, until: int | None = None
) -> TurnSimulator:
    """Play every env of a simulator from the start of its episode to the end; returns the simulator.

    `until`: stop as soon as every env that is not over has come so far (`TurnSimulator.progress`) or farther.
    """
    scheduler.start(simulator, np.ones(simulator.batch, np.bool_))
    player = scheduler.epoch_player(simulator)
    number = 0
    while _goes_on(simulator, until):
        if player is not None:
            shares, decisions = player(EPOCHS_AT_ONCE)
            if watcher is not None:
                watcher.played(simulator, shares, decisions)
            continue
        if watcher is not None:
            watcher.before(simulator, number)
        simulator.step(scheduler.decide(simulator))
        number += 1
    return simulator


def _goes_on(simulator: TurnSimulator, until: int | None) -> bool:
    """Whether an env still plays that has not come as far as `until`."""
    playing = simulator.acting >= 0
    return bool(playing.any() if until is None else (playing & (simulator.progress < until)).any())

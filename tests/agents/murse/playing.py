"""Playing schedulers in the simulator, and what the validator says of the result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.validation import validate


def finished(scheduler: Scheduler, problems: Sequence[MurseInstance], **options: Any) -> MurseSimulator:
    """A simulator of these problems after a whole episode under the scheduler."""
    simulator = MurseSimulator(problems, **{**scheduler.simulator_options, **options})
    scheduler.start(simulator, np.ones(simulator.batch, np.bool_))
    while not simulator.over.all():
        simulator.step(scheduler.decide(simulator))
    return simulator


def assert_confirmed(simulator: MurseSimulator) -> None:
    """Every round of every row is feasible exactly if the validator says so, at the same times."""
    for row in range(simulator.batch):
        for k, result in enumerate(simulator.round_results(row)):
            verdict = validate(schedule(simulator, row, k))
            assert verdict.feasible == result["feasible"], (row, k, verdict)
            assert not verdict.given_broken or not result["feasible"], (row, k, verdict)

"""What the bench measures of MuRSE alone: timing whole schedules, and how long a rule takes to make one."""

from __future__ import annotations

import numpy as np

from marl_sched.agents.benchmark import Benchmark
from marl_sched.agents.murse.list_schedule import edf_schedule
from marl_sched.agents.murse.problem import Round
from marl_sched.domain import Domain
from marl_sched.envs.murse.timetable import time_batch

_N_TASKS, _N_AGENTS = 10, 4  # of the small instance whose schedules are timed


def benchmarks(domain: Domain, batch: int) -> dict[str, Benchmark]:
    """Microseconds to time one of `batch` whole schedules, milliseconds in which EDF makes one of many tasks."""
    return {f"schedule_us_b{batch}": _schedules(domain, batch), "edf_large_ms": _edf(domain)}


def _schedules(domain: Domain, batch: int) -> Benchmark:
    sizes = (_N_TASKS, _N_AGENTS)
    instance = next(i for i in domain.instances("small", 100, 0) if (i.n_tasks, i.n_agents) == sizes)
    rng = np.random.default_rng(0)
    orders = np.stack([rng.permutation(instance.n_tasks) for _ in range(batch)])
    doers = rng.integers(instance.n_agents, size=orders.shape)
    problem = (instance.mean_durations, instance.lags, instance.near, instance.deadlines)
    return Benchmark(
        play=lambda: time_batch(orders, doers, *problem),
        per_second=1e6 / batch,
        meaning=f"microseconds per whole schedule of a small instance ({_N_TASKS} tasks, {_N_AGENTS} agents), timed "
        f"and checked, {batch} at a time",
    )


def _edf(domain: Domain) -> Benchmark:
    largest = max(domain.instances("large", 10, 0), key=lambda instance: instance.n_tasks)
    return Benchmark(
        play=lambda: edf_schedule(Round.of(largest)),
        per_second=1e3,
        meaning="milliseconds in which the rule edf makes a whole schedule, the largest of ten large instances",
    )

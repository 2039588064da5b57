"""What the bench measures of AirME alone: the simulator by itself, without observations or turns."""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_sched.agents.benchmark import Benchmark
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import Domain


def benchmarks(domain: Domain, batch: int) -> dict[str, Benchmark]:
    """Microseconds per simulated hour of one and of `batch` small instances played to their end."""
    return {f"hour_us_b{rows}": _hours(domain, rows) for rows in (1, batch)}


def _hours(domain: Domain, batch: int) -> Benchmark:
    simulator, choices = prepared_hours(domain, batch)
    return Benchmark(
        play=lambda: play_hours(simulator, choices),
        per_second=1e6 / (batch * len(choices)),
        meaning="microseconds per simulated hour and small instance in play_hour(), the condition-based rule's "
        "decisions prepared beforehand",
        prepare=simulator.reset,
    )


def prepared_hours(domain: Domain, batch: int) -> tuple[Any, np.ndarray]:
    """A simulator and the condition-based rule's actions for all its hours and crews, int64 (T, B, C)."""
    simulator: Any = domain.simulator(domain.instances("small", batch, 0), pad="small")
    rule = create_scheduler("condition", domain)
    choices = np.zeros((domain.default_horizon, batch, simulator.max_agents), np.int64)
    while (rows := np.flatnonzero(simulator.acting >= 0)).size:
        actions = rule.decide(simulator)
        choices[simulator.time[rows], rows, simulator.acting[rows]] = actions[rows]
        simulator.step(actions)
    return simulator, choices


def play_hours(simulator: Any, choices: np.ndarray) -> None:
    """Play the hours of prepared choices, int64 (T, B, C)."""
    for hour in choices:
        simulator.play_hour(hour)

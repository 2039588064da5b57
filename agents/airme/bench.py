"""What the bench measures of AirME alone: hours of the simulator, by themselves and with a rule that decides."""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_sched.agents.airme.rules import condition
from marl_sched.agents.benchmark import Benchmark
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import Domain
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES
from marl_sched.envs.airme.instance import AirmeInstance

RULE_HOURS = 240  # of an episode in which a rule decides


def benchmarks(domain: Domain, batch: int) -> dict[str, Benchmark]:
    """Microseconds per simulated hour of one and of `batch` instances played to their end."""
    hours = {f"hour_us_b{rows}": _hours(domain, rows) for rows in (1, batch)}
    rules = {
        f"condition_hour_us_{planes}_planes_b{rows}": _rule_hours(domain, planes, rows)
        for planes in (30, 60, 120)
        for rows in (1, batch)
    }
    return {**hours, **rules}


def fleet(planes: int, crews: int, seed: int) -> AirmeInstance:
    """A fleet of that size, two thirds of it fixed-wing, otherwise as the generator draws."""
    rng = np.random.default_rng(seed)
    kind = np.repeat([0, 1], [planes * 2 // 3, planes - planes * 2 // 3])
    low, high = np.array([PUBLISHED_TYPES[k].income for k in kind]).T
    hours = rng.integers(0, 121, planes)
    return AirmeInstance(
        n_crews=crews,
        kind=kind,
        income=rng.uniform(low, high),
        hours=hours,
        landings=hours // 7,
        broken=rng.random(planes) < 0.1,
    )


def _rule_hours(domain: Domain, planes: int, batch: int) -> Benchmark:
    crews = round(planes * 7 / 30)
    fleets = [fleet(planes, crews, seed) for seed in range(batch)]
    simulator: Any = domain.simulator(fleets, horizon=RULE_HOURS)
    player = condition().epoch_player(simulator)

    def play() -> None:
        while (simulator.acting >= 0).any():
            player(1)

    return Benchmark(
        play=play,
        per_second=1e6 / (batch * RULE_HOURS),
        meaning=f"microseconds per simulated hour of {planes} planes and {crews} crews, the condition-based rule "
        "deciding",
        prepare=simulator.reset,
    )


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

"""The schedulers of AirME by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from marl_sched.agents.airme.bound.index import IndexScheduler
from marl_sched.agents.airme.light_rules import RandomRule
from marl_sched.agents.airme.rules import (
    ModelBasedRule,
    PeriodicRule,
    condition,
    corrective,
    corrective_as_published,
    preventive_first,
)
from marl_sched.agents.base import ObservationScheduler

RULES: dict[str, Callable[[], ObservationScheduler]] = {
    "random": RandomRule,
    "corrective": corrective,
    "corrective-published": corrective_as_published,
    "condition": condition,
    "periodic": PeriodicRule,
    "model-based": ModelBasedRule,
    "preventive-first": preventive_first,
    "index": IndexScheduler,
    "index-without-clock": partial(IndexScheduler, clock=False),
}

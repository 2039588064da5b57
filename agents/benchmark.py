"""What only one domain has to measure in `marl-sched bench`.

A domain's own measurements are `Domain.benchmarks(domain, batch) -> {figure: Benchmark}`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from marl_sched.domain import Domain


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """One thing to measure.

    Attributes:
        play: what is timed.
        per_second: what a second that `play` takes counts in the figure: 1e6 / n gives microseconds for each of n.
        meaning: what the figure is of.
        better: whether a higher or a lower figure is the faster one; a time is lower.
        prepare: run before every `play`, untimed.
    """

    play: Callable[[], Any]
    per_second: float
    meaning: str
    better: Literal["higher", "lower"] = "lower"
    prepare: Callable[[], Any] = lambda: None


def own_benchmarks(domain: Domain, batch: int) -> Mapping[str, Benchmark]:
    """A domain's own measurements by the figure's name, of `batch` instances where it is of many; empty for none."""
    return {} if domain.benchmarks is None else domain.benchmarks(domain, batch)

"""What only one domain has to measure in `marl-sched bench`.

A domain's own measurements stand in `benchmarks(domain, batch) -> {figure: Benchmark}` of
`marl_sched.agents.<domain>.bench`, which is imported when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from marl_sched.domain import Domain


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """One thing to measure.

    Attributes:
        play: what is timed.
        per_second: what a second that `play` takes counts in the figure: 1e6 / n gives microseconds for each of n.
        meaning: what the figure is of.
        prepare: run before every `play`, untimed.
    """

    play: Callable[[], Any]
    per_second: float
    meaning: str
    prepare: Callable[[], Any] = lambda: None


def own_benchmarks(domain: Domain, batch: int) -> Mapping[str, Benchmark]:
    """A domain's own measurements by the figure's name, of `batch` instances where it is of many; empty for none."""
    module = f"marl_sched.agents.{domain.name}.bench"
    if find_spec(f"marl_sched.agents.{domain.name}") is None or find_spec(module) is None:
        return {}
    return import_module(module).benchmarks(domain, batch)

"""Advice for one problem as it stands now: who should do what, why, and what the time to come looks like.

Futures are episodes of the problem that differ by their noise alone, which is counter-based: variants of a problem, by
another scheduler or with another setting, meet the same noise and are compared future by future.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from marl_sched.agents.base import Scheduler, Worths
from marl_sched.agents.playing import play
from marl_sched.planning import Advice, Measure
from marl_sched.problem import Problem
from marl_sched.simulation import TurnSimulator
from marl_sched.train.evaluation.evaluate import own_options

BAND = 0.8  # share of the futures between the ends of a band


@dataclass(frozen=True)
class Candidate:
    """A choice that an agent has now: what it is, what is known of it, and what it is worth (None: not told).

    `first` marks those that the scheduler puts before all others.
    """

    action: int
    name: str
    facts: Mapping[str, Any]
    worth: float | None
    first: bool


@dataclass(frozen=True)
class Decision:
    """What one free agent should do now, and what else it could do, best first.

    `taken`: somebody whom it does not hear chose the same before; then it does nothing.
    """

    agent: str
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    meaning: str  # of what candidates are worth, "" if nothing is told
    taken: bool = False


def decide_now(problem: Problem, scheduler: Scheduler, appraiser: Scheduler, advice: Advice) -> list[Decision]:
    """The decisions of all agents that are free at the start of the problem, in turn order.

    Worths are the scheduler's own; where it tells none, those of `appraiser`.
    """
    simulator = problem.simulator([0], **own_options(scheduler, problem))
    simulator.reset(seed=problem.seed, episodes=problem.episode_numbers([0]))
    everywhere = np.ones(1, np.bool_)
    scheduler.start(simulator, everywhere)
    names = problem.domain.agent_names(problem.instances[0], int(simulator.n_agents[0]))
    left = set(simulator.free_agents(0).tolist())
    found: list[Decision] = []
    started = False
    while int(simulator.acting[0]) in left:
        agent = int(simulator.acting[0])
        left.remove(agent)
        legal = simulator.legal()[0] > 0
        worths, who = scheduler.worths(simulator), ""
        if worths is None:
            if not started:
                appraiser.start(simulator, everywhere)
                started = True
            worths, who = appraiser.worths(simulator), f", while {scheduler.name} tells none"
        actions = scheduler.decide(simulator)
        decision = _decision(names[agent], advice.choices(simulator, 0), legal, int(actions[0]), worths, who)
        simulator.step(actions)
        found.append(replace(decision, taken=bool(simulator.conflict[0])))
    return found


def _decision(
    agent: str,
    choices: Sequence[tuple[str, Mapping[str, Any]]],
    legal: np.ndarray,
    action: int,
    worths: Worths | None,
    who: str,
) -> Decision:
    candidates = []
    for k in np.flatnonzero(legal).tolist():
        value = None if worths is None or not np.isfinite(worths.values[0, k]) else float(worths.values[0, k])
        first = worths is not None and worths.first is not None and bool(worths.first[0, k])
        candidates.append(Candidate(k, *choices[k], value, first))
    sign = -1.0 if worths is not None and worths.better == "lower" else 1.0
    candidates.sort(
        key=lambda one: (one.action == action, one.first, -np.inf if one.worth is None else sign * one.worth),
        reverse=True,
    )
    return Decision(agent, candidates[0], tuple(candidates), "" if worths is None else worths.meaning + who)


@dataclass(frozen=True)
class Futures:
    """Simulated futures of one variant.

    Attributes:
        totals: measure -> float64 (N, steps), joined over the units of each step.
        simulator: with a row for each future, from which pictures are drawn.
        better: measure -> "higher" or "lower".
    """

    totals: Mapping[str, np.ndarray]
    simulator: TurnSimulator
    better: Mapping[str, str]

    def bands(self) -> dict[str, list[dict[str, float | None]]]:
        """Measure -> for each step its median over the futures and the ends of the band of BAND; None: no value."""
        low, high = (1 - BAND) / 2, (1 + BAND) / 2
        return {
            name: [
                {"median": _quantile(step, 0.5), "low": _quantile(step, low), "high": _quantile(step, high)}
                for step in values.T
            ]
            for name, values in self.totals.items()
        }

    def overall(self) -> dict[str, np.ndarray]:
        """Measure -> float64 (N,), the mean over the steps of each future, NaN where it has none."""
        return {name: _mean(values) for name, values in self.totals.items()}

    @property
    def median_row(self) -> int:
        """The future whose first measure is the median of all, the lower one of two."""
        values = next(iter(self.overall().values()))
        order = np.argsort(values, kind="stable")
        return int(order[(len(order) - 1) // 2])


def play_futures(problem: Problem, scheduler: Scheduler, advice: Advice, *, count: int, steps: int) -> Futures:
    """Play `count` futures of a problem by a scheduler, as far as `steps` reach."""
    per = advice.step[1]
    options = {**own_options(scheduler, problem), **problem.domain.render_options.get("rgb_array", {})}
    simulator = problem.simulator([0] * count, **options)
    simulator.reset(seed=problem.seed, episodes=problem.episode_numbers(range(count)))
    play(scheduler, simulator, until=per * steps)
    totals, better = {}, {}
    for name, measure in advice.outlook(simulator).items():
        totals[name], better[name] = _joined(measure, per, steps), measure.better
    return Futures(totals, simulator, better)


def _joined(measure: Measure, per: int, steps: int) -> np.ndarray:
    """A measure's values over the units of time as float64 (N, steps)."""
    values = measure.values[:, : per * steps]
    parts = values.reshape(len(values), -1, per) if per > 1 else values[:, :, None]
    return parts.sum(axis=2) if measure.joined == "sum" else _mean(parts)


def compare_futures(base: Futures, other: Futures) -> dict[str, dict[str, float | None]]:
    """What another variant has more than the base in the same futures, measure by measure.

    The median and the band of the differences of futures, their mean with its standard error, and the share of futures
    in which the other one is better.
    """
    found = {}
    for name, values in base.overall().items():
        difference = other.overall()[name] - values
        there = difference[~np.isnan(difference)]
        gain = there > 0 if base.better[name] == "higher" else there < 0
        error = float(there.std(ddof=1) / np.sqrt(len(there))) if len(there) > 1 else None
        found[name] = {
            "median": _quantile(there, 0.5),
            "low": _quantile(there, (1 - BAND) / 2),
            "high": _quantile(there, (1 + BAND) / 2),
            "mean": float(there.mean()) if len(there) else None,
            "standard_error": error,
            "better_share": float(gain.mean()) if len(there) else None,
        }
    return found


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean over the last axis without NaN, NaN where there is nothing else."""
    there = ~np.isnan(values)
    count = there.sum(axis=-1)
    return np.where(count > 0, np.where(there, values, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _quantile(values: np.ndarray, level: float) -> float | None:
    there = values[~np.isnan(values)]
    return float(np.quantile(there, level)) if len(there) else None

"""How far schedulers are from the exact one and from proved bounds, in all and by instance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from marl_sched.problem import Problem
from marl_sched.train.evaluation.results import Gap, InstanceRow, InstanceScores

if TYPE_CHECKING:
    from marl_sched.train.evaluation.evaluate import Scores

SOLVER_MEASURES = ("bound", "optimal", "timed_out", "without_plan", "solver_seconds")


def gaps(scores: Scores, exact: Scores, objective: str) -> tuple[Gap, Gap | None]:
    """The gap to the exact scheduler and, where that proved bounds, to the bounds.

    Rounds count that are feasible for both, and for the bound those that are feasible; `rounds` says how many. Without
    measures by round, whole episodes are compared.
    """
    ours, theirs = _by_round(scores, objective), _by_round(exact, objective)
    to_bound = _gap(ours, exact.per_round["bound"]) if "bound" in exact.per_round else None
    return _gap(ours, theirs), to_bound


def _by_round(scores: Scores, objective: str) -> np.ndarray:
    """The objective, float64 (I, E, rounds), NaN where a round was infeasible; (I, E) if it is not told by round."""
    if objective not in scores.per_round:
        return scores.measures[objective]
    feasible = scores.per_round.get("feasible", np.ones(1))
    return np.where(feasible == 1.0, scores.per_round[objective], np.nan)


def _gap(ours: np.ndarray, base: np.ndarray) -> Gap:
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = np.where(base != 0, 100.0 * (ours - base) / np.abs(base), np.where(ours == base, 0.0, np.nan))
    both = percent[~np.isnan(percent)]
    if both.size == 0:
        return Gap(mean=None, std=None, rounds=0)
    return Gap(mean=float(both.mean()), std=float(both.std()), rounds=int(both.size))


def by_instance(problem: Problem, scores: Mapping[str, Scores]) -> list[InstanceRow]:
    """A row per instance: its file, and what every scheduler reached on it."""
    files = problem.files or (None,) * problem.count
    return [
        InstanceRow(
            instance=i,
            file=None if files[i] is None else str(files[i]),
            schedulers={name: _instance_scores(one, i, problem.objective) for name, one in scores.items()},
        )
        for i in range(problem.count)
    ]


def _instance_scores(scores: Scores, i: int, objective: str) -> InstanceScores:
    mean = float(scores.measures[objective][i].mean())
    rounds = {name: values[i] for name, values in scores.per_round.items()}
    feasible = mean_of(rounds["feasible"]) if "feasible" in rounds else None
    if "bound" not in rounds:
        return InstanceScores(objective=mean, feasible=feasible)
    solved = {name: rounds[name][~np.isnan(rounds["optimal"])] for name in SOLVER_MEASURES}
    return InstanceScores(
        objective=mean,
        feasible=feasible,
        status="no plan"
        if solved["without_plan"].any()
        else "optimal"
        if (solved["optimal"] > 0).all()
        else "feasible",
        bound=mean_of(rounds["bound"]),
        gap_to_bound=_gap(_by_round(scores, objective)[i], rounds["bound"]).mean,
        timed_out=int(solved["timed_out"].sum()),
        seconds=mean_of(rounds["solver_seconds"]),
    )


def mean_of(values: np.ndarray) -> float | None:
    """The mean of what was measured, None if nothing was; JSON knows no NaN."""
    measured = values[~np.isnan(values)]
    return float(measured.mean()) if measured.size else None

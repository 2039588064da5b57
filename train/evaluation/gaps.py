"""How far schedulers are from the exact one and from proved bounds, in all and by instance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.problem import Problem

if TYPE_CHECKING:
    from marl_sched.train.evaluation.evaluate import Scores

SOLVER_MEASURES = ("bound", "optimal", "timed_out", "without_plan", "solver_seconds")


def gaps(scores: Scores, exact: Scores, objective: str) -> dict[str, Any]:
    """`gap_to_exact` and, where the exact scheduler proved bounds, `gap_to_bound`, in percent.

    Rounds count that are feasible for both, and for the bound those that are feasible; `rounds` says how many. Without
    measures by round, whole episodes are compared.
    """
    ours, theirs = _by_round(scores, objective), _by_round(exact, objective)
    found = {"gap_to_exact": _gap(ours, theirs)}
    if "bound" in exact.per_round:
        found["gap_to_bound"] = _gap(ours, exact.per_round["bound"])
    return found


def _by_round(scores: Scores, objective: str) -> np.ndarray:
    """The objective, float64 (I, E, rounds), NaN where a round was infeasible; (I, E) if it is not told by round."""
    if objective not in scores.per_round:
        return scores.measures[objective]
    feasible = scores.per_round.get("feasible", np.ones(1))
    return np.where(feasible == 1.0, scores.per_round[objective], np.nan)


def _gap(ours: np.ndarray, base: np.ndarray) -> dict[str, float | int | None]:
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = np.where(base != 0, 100.0 * (ours - base) / np.abs(base), np.where(ours == base, 0.0, np.nan))
    both = percent[~np.isnan(percent)]
    if both.size == 0:
        return {"mean": None, "std": None, "rounds": 0}
    return {"mean": float(both.mean()), "std": float(both.std()), "rounds": int(both.size)}


def by_instance(problem: Problem, scores: Mapping[str, Scores]) -> list[dict[str, Any]]:
    """A row per instance: its file, and per scheduler the mean objective and the share of feasible rounds.

    Of a solver also status, bound, gap to the bound in percent, runs that a limit ended, and seconds per round. The
    status is that of all rounds: "optimal" if all were proved, "no plan" if one had no feasible plan, else "feasible".
    """
    files = problem.files or (None,) * problem.count
    return [
        {
            "instance": i,
            "file": None if files[i] is None else str(files[i]),
            "schedulers": {name: _instance_row(one, i, problem.objective) for name, one in scores.items()},
        }
        for i in range(problem.count)
    ]


def _instance_row(scores: Scores, i: int, objective: str) -> dict[str, Any]:
    row: dict[str, Any] = {"objective": float(scores.measures[objective][i].mean())}
    rounds = {name: values[i] for name, values in scores.per_round.items()}
    if "feasible" in rounds:
        row["feasible"] = _mean(rounds["feasible"])
    if "bound" in rounds:
        solved = {name: rounds[name][~np.isnan(rounds["optimal"])] for name in SOLVER_MEASURES}
        row["status"] = (
            "no plan" if solved["without_plan"].any() else "optimal" if (solved["optimal"] > 0).all() else "feasible"
        )
        row["bound"] = _mean(rounds["bound"])
        row["gap_to_bound"] = _gap(_by_round(scores, objective)[i], rounds["bound"])["mean"]
        row["timed_out"] = int(solved["timed_out"].sum())
        row["seconds"] = _mean(rounds["solver_seconds"])
    return row


def _mean(values: np.ndarray) -> float | None:
    """The mean of what was measured, None if nothing was."""
    measured = values[~np.isnan(values)]
    return float(measured.mean()) if measured.size else None

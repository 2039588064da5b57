"""Learning curves of many runs in one picture: a line for every seed and the mean of those that belong together.

The numbers come first, as JSON; the picture is drawn from them (marl_sched.train.evaluation.plots.curves_by_group).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError, require
from marl_sched.train.config import RunRecord, load_record
from marl_sched.train.evaluation.compare import read_curve
from marl_sched.train.export import CONFIG

SCHEMA = 2  # 1 had no unit
# What may be on the x-axis -> its column in a log, the name it had before version 0.2 last.
AXES = {"updates": ("update",), "time": ("time", "hours"), "seconds": ("seconds",)}
MEASURES = ("reward_rate", "validation")
SMOOTHED = {"reward_rate": 10, "validation": 1}  # points that are averaged over unless another number is asked for


def learning_curves(
    runs: Sequence[Path],
    *,
    x: str = "updates",
    measure: str = "reward_rate",
    smooth: int | None = None,
    by: str = "algorithm.name",
) -> dict[str, Any]:
    """What several runs scored while they trained, as JSON.

    Args:
        runs: folders of runs.
        x: "updates", "time" (simulated, over all envs) or "seconds" (wall time).
        measure: "reward_rate", M1 of the sampling policy in training, or "validation", on fixed instances.
        smooth: a point is the mean of so many, itself the last; None: see SMOOTHED.
        by: runs with the same value of this key of their configuration are a group, for example `view.reach`. The
            algorithm of `algorithm=reinforce` is step_baseline, with other settings; `policy.name` tells them apart.

    Returns `{"schema", "x", "unit", "measure", "smooth", "by", "groups": {NAME: {"mean": {"x": [...], "y": [...]},
    "runs": [{"run", "seed", "x": [...], "y": [...]}]}}}`; `unit` is that of simulated time. A group's mean is over its
    runs, on the points of the run that has fewest, as far as all of them went; between its points a run is taken to be
    linear.
    Raises InvalidFileError for a folder without a run's files, InvalidOptionError or UnknownNameError for the rest.
    """
    require("x-axis", x, AXES)
    require("measure", measure, MEASURES)
    smooth = SMOOTHED[measure] if smooth is None else smooth
    if smooth < 1:
        raise InvalidOptionError(f"smooth: expected at least 1 point, got {smooth}")
    if not runs:
        raise InvalidOptionError("runs: expected at least one")
    found: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        record = load_record(run / CONFIG)
        unit = get_domain(record.config.env.name).unit
        xs, ys = read_curve(run / "progress.csv", AXES[x], measure)
        curve = {"run": run.absolute().name, "seed": record.config.seed, "x": xs.tolist()}
        found.setdefault(_group(record, by), []).append(curve | {"y": trailing_mean(ys, smooth).tolist()})
    groups = {name: {"mean": _mean(curves), "runs": curves} for name, curves in found.items()}
    return {"schema": SCHEMA, "x": x, "unit": unit, "measure": measure, "smooth": smooth, "by": by, "groups": groups}


def trailing_mean(values: np.ndarray, count: int) -> np.ndarray:
    """The mean of each of `values`, float64 (N,), and the count - 1 before it, or as many as there are."""
    return np.array([values[max(end - count, 0) : end].mean() for end in range(1, len(values) + 1)])


def _group(record: RunRecord, key: str) -> str:
    value = msgspec.to_builtins(record.config)
    for word in key.split("."):
        if not isinstance(value, dict) or word not in value:
            raise InvalidOptionError(f"by: expected a key of a run's configuration such as algorithm.name, got {key!r}")
        value = value[word]
    return str(value)


def _mean(curves: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    fewest = np.array(min((curve["x"] for curve in curves), key=len))
    first, last = max(curve["x"][0] for curve in curves), min(curve["x"][-1] for curve in curves)
    shared = fewest[(fewest >= first) & (fewest <= last)]
    mean = np.mean([np.interp(shared, curve["x"], curve["y"]) for curve in curves], axis=0)
    return {"x": shared.tolist(), "y": mean.tolist()}

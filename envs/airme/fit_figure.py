"""The picture of fitted failure records: survival as recorded and fitted, and what the simulator makes of it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import CensoredData, ecdf

from marl_sched.envs.airme.fitting import Fit, PartFit

_INK, _FITTED, _BAND, _DENSITY = "#22303c", "#2b6a9b", "#c9d1d8", "#e08e0b"


def draw_fit(fit: Fit) -> Figure:
    """For each part: survival against usage, and the failure probability of an hour in the simulator's two models."""
    figure = Figure(figsize=(10.0, 0.8 + 2.7 * len(fit.parts)), layout="constrained")
    rows = figure.subplots(len(fit.parts), 2, squeeze=False)
    for (left, right), part in zip(rows, fit.parts, strict=True):
        usage = np.linspace(0.0, 1.15 * _greatest(part), 300)[1:]
        _survival(left, part, usage)
        ratio = usage / part.scale
        hazard = part.shape / part.scale * ratio ** (part.shape - 1)
        right.plot(usage, np.minimum(hazard, 1.0), color=_FITTED, label="--failure hazard: as recorded")
        right.plot(usage, hazard * np.exp(-(ratio**part.shape)), color=_DENSITY, ls="--", label="density: as published")
        right.set_title("probability that a unit of usage ends in a failure", fontsize=9, loc="left")
        right.legend(frameon=False, fontsize=8)
        for axes in (left, right):
            axes.set_xlabel(f"usage in {part.wears_with}", fontsize=9)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=8)
    return figure


def _greatest(part: PartFit) -> float:
    records = part.records
    return max(float(values.max()) for values in (records.failed, records.running, records.between) if values.size)


def _survival(axes: Any, part: PartFit, usage: np.ndarray) -> None:
    """The share that still runs: recorded (Kaplan and Meier, failures by inspection at their usage) and fitted."""
    records = part.records
    failed = np.concatenate([records.failed, records.between[:, 1]])
    recorded = ecdf(CensoredData(uncensored=failed, right=records.running)).sf
    x = np.concatenate([[0.0], recorded.quantiles])
    axes.step(x, np.concatenate([[1.0], recorded.probabilities]), where="post", color=_INK, lw=1.2, label="recorded")
    if len(failed) > 1:
        with warnings.catch_warnings():  # where nobody or everybody has failed there is no interval: drawn from 0 to 1
            warnings.filterwarnings("ignore", "The confidence interval is undefined", RuntimeWarning)
            low, high = (end.probabilities for end in recorded.confidence_interval(method="log-log"))
        ends = [np.concatenate([[1.0], np.where(np.isnan(end), edge, end)]) for end, edge in ((low, 0.0), (high, 1.0))]
        axes.fill_between(x, *ends, step="post", color=_BAND, alpha=0.6, lw=0, label="95 % of the recorded")
    fitted = np.exp(-((usage / part.scale) ** part.shape))
    axes.plot(usage, fitted, color=_FITTED, label=f"Weibull, scale {part.scale:.4g}, shape {part.shape:.3g}")
    failures = f"{records.failures} failures, {len(records.running)} running"
    axes.set_title(f"{part.kind}, {part.part}: share that still runs ({failures})", fontsize=9, loc="left")
    axes.set_ylim(0, 1.02)
    axes.legend(frameon=False, fontsize=8)

"""Pictures of results, drawn from JSON and logs with matplotlib; every function returns a Figure and writes nothing.

Figures are made without pyplot: there is no global state and no display is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from marl_sched.files import replacing

_BAR, _ACCENT, _INK, _FAINT = "#8fb8d8", "#2b6a9b", "#22303c", "#c9d1d8"
_LINES = ("#2b6a9b", "#cb4335", "#e08e0b", "#3c8d5a", "#7d5ba6", "#5d6d7e")


def save(figure: Figure, path: Path) -> Path:
    """Write a figure, beside and renamed, in the format that the path's suffix says; the path."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)
    return path


def score_bars(results: Mapping[str, Any]) -> Figure:
    """M1 of every scheduler of an evaluation (schema 1): interquartile mean with its interval, and mean."""
    rows = sorted(results["schedulers"].items(), key=lambda item: item[1]["M1"]["mean"])
    names = [name for name, _ in rows]
    scores = [row["M1"] for _, row in rows]
    iqm = np.array([score["iqm"] for score in scores])
    low, high = np.array([score["ci95"] for score in scores]).T
    figure = Figure(figsize=(8.0, 1.6 + 0.42 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    y = np.arange(len(rows))
    axes.barh(y, iqm, color=_BAR, height=0.62, label="interquartile mean")
    axes.errorbar(
        iqm, y, xerr=(iqm - low, high - iqm), fmt="none", ecolor=_INK, capsize=3, lw=1.3, label="its 95 % interval"
    )
    axes.plot([score["mean"] for score in scores], y, "D", color=_ACCENT, ms=4.5, mec="white", mew=0.6, label="mean")
    right = max(0.0, high.max(), max(score["mean"] for score in scores))
    for position, bound, score in zip(y, high, scores, strict=True):
        beside = max(bound, score["mean"], 0.0) + 0.015 * right
        axes.text(beside, position, f"{score['mean']:.3f}", va="center", fontsize=9, color=_INK)
    axes.set_yticks(y, names)
    axes.set_xlim(min(0.0, 1.05 * low.min()), 1.12 * right or 1.0)
    axes.set_xlabel(f"M1: mean {results['objective']} over {results['hours']} hours")
    axes.set_title(_conditions(results), fontsize=10, loc="left")
    _plain(axes)
    axes.grid(axis="x", color=_FAINT, lw=0.6)
    axes.tick_params(axis="y", length=0)
    figure.legend(loc="outside lower right", ncols=3, frameon=False, fontsize=8)
    return figure


def timelines(
    panels: Mapping[str, np.ndarray],
    *,
    hours: int,
    legend: Mapping[str, Sequence[int]] | None = None,
    band: tuple[str, int] | None = None,
    title: str = "",
) -> Figure:
    """One episode as several schedulers played it: a caption -> uint8 image (height, width, 3) for each panel.

    `hours` is what the width of an image stands for. `legend` says what colours mean, `band` what a band of
    that many pixels stands for; pictures that come with axes of their own have neither.
    """
    heights = [0.6 + image.shape[0] / 110 for image in panels.values()]
    figure = Figure(figsize=(10.0, 1.0 + sum(heights)), layout="constrained")
    all_axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for axes, (caption, image) in zip(all_axes, panels.items(), strict=True):
        if band is None:
            axes.imshow(image, aspect="auto")
            axes.set_axis_off()
        else:
            count = image.shape[0] // band[1]
            axes.imshow(image, aspect="auto", interpolation="nearest", extent=(0, hours, count + 0.5, 0.5))
            axes.set_ylabel(band[0])
            axes.set_yticks([1, *range(10, count + 1, 10)])
            _plain(axes)
        axes.set_title(caption, fontsize=10, loc="left")
    if band is not None:
        all_axes[-1].set_xticks(range(0, hours + 1, 24 * max(1, round(hours / 24 / 15))))
        all_axes[-1].set_xlabel("hour")
    if title:
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    if legend is not None:
        patches = [Patch(color=np.divide(colour, 255), label=label) for label, colour in legend.items()]
        figure.legend(handles=patches, loc="outside lower right", ncols=len(patches), frameon=False, fontsize=9)
    return figure


def learning_curves(curves: Mapping[str, tuple[np.ndarray, np.ndarray]], *, measure: str = "M1") -> Figure:
    """Scores over minutes of training: name -> (minutes float64 (N,), scores float64 (N,))."""
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, (minutes, scores)) in enumerate(curves.items()):
        colour = _LINES[i % len(_LINES)]
        axes.plot(minutes, scores, "-", color=colour, lw=1.6, marker="o", ms=3, label=name)
        best = int(np.argmax(scores))
        axes.annotate(
            f"{scores[best]:.3f}",
            (minutes[best], scores[best]),
            xytext=(0, 6),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=colour,
        )
    axes.set_xlabel("minutes of training")
    axes.set_ylabel(f"{measure} on validation instances")
    _plain(axes)
    axes.grid(color=_FAINT, lw=0.6)
    axes.legend(frameon=False, loc="lower right", fontsize=9)
    return figure


def _conditions(results: Mapping[str, Any]) -> str:
    view = results["view"]
    scale = results["scale"] or "given"
    return (
        f"{results['env']}, {results['instances']} {scale} instances x {results['episodes']} episodes, "
        f"{view['kind']} view ({100 * view['visible_share']:.0f} % of the graph seen)"
    )


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)

"""Pictures of results and logs, drawn with matplotlib; every function returns a Figure and writes nothing.

Figures are made without pyplot: there is no global state and no display is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from marl_sched.files import replacing
from marl_sched.problem import Problem
from marl_sched.train.evaluation.results import Results

_INK, _FAINT = "#22303c", "#c9d1d8"
_BARS = ("#8fb8d8", "#f0b96b", "#a7cfa4", "#c6b3dc")
_LINES = ("#2b6a9b", "#cb4335", "#e08e0b", "#3c8d5a", "#7d5ba6", "#5d6d7e")


def save(figure: Figure, path: Path) -> Path:
    """Write a figure, beside and renamed, in the format that the path's suffix says; the path."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)
    return path


def score_bars(*tables: Results) -> Figure:
    """M1 of the schedulers of one or more evaluations: interquartile mean with its interval, and mean.

    Tables differ in colour and are told apart by their views.
    """
    rows = [(name, row.M1, i) for i, table in enumerate(tables) for name, row in table.schedulers.items()]
    problem = tables[0].problem
    rows.sort(key=lambda row: row[1].mean, reverse=problem.domain.better == "lower")
    scores = [score for _, score, _ in rows]
    iqm = np.array([score.iqm for score in scores])
    kind = "such" if all(score.ci95_such_instances for score in scores) else "these"
    intervals = [score.ci95_such_instances if kind == "such" else score.ci95_these_instances for score in scores]
    drawn = [interval or (score.iqm,) * 2 for interval, score in zip(intervals, scores, strict=True)]
    low, high = np.array(drawn).T
    means = np.array([score.mean for score in scores])
    figure = Figure(figsize=(8.5, 1.9 + 0.4 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    y = np.arange(len(rows))
    axes.barh(y, iqm, color=[_BARS[table % len(_BARS)] for _, _, table in rows], height=0.62)
    axes.errorbar(iqm, y, xerr=(iqm - low, high - iqm), fmt="none", ecolor=_INK, capsize=3, lw=1.3)
    axes.plot(means, y, "D", color=_INK, ms=4, mec="white", mew=0.6)
    right = max(0.0, high.max(), means.max())
    for position, bound, mean, bar in zip(y, high, means, iqm, strict=True):
        axes.text(
            max(bound, mean, 0.0) + 0.015 * right, float(position), f"{bar:.3f}", va="center", fontsize=9, color=_INK
        )
    axes.set_yticks(y, [name for name, _, _ in rows])
    axes.set_xlim(min(0.0, 1.05 * low.min()), 1.12 * right or 1.0)
    axes.set_xlabel(f"M1: {problem.domain.in_words(problem.objective, problem.length)}")
    axes.set_title(_conditions(problem), fontsize=10, loc="left")
    _plain(axes)
    axes.grid(axis="x", color=_FAINT, lw=0.6)
    axes.tick_params(axis="y", length=0)
    handles: list[Any] = [Patch(color=_BARS[i % len(_BARS)], label=_view(table)) for i, table in enumerate(tables)]
    handles.append(
        Line2D(
            [],
            [],
            color=_INK,
            marker="|",
            ms=8,
            label=f"95 % interval of the interquartile mean (bar and number), {kind} instances",
        )
    )
    handles.append(Line2D([], [], color=_INK, marker="D", ms=4, ls="none", label="mean"))
    figure.legend(handles=handles, loc="outside lower right", ncols=2, frameon=False, fontsize=8)
    return figure


def timelines(
    panels: Mapping[str, np.ndarray],
    *,
    length: int,
    unit: str,
    legend: Mapping[str, Sequence[int]] | None = None,
    band: tuple[str, int] | None = None,
    title: str = "",
) -> Figure:
    """One episode as several schedulers played it: a caption -> uint8 image (height, width, 3) for each panel.

    `length` is what the width of an image stands for, counted in `unit`. `legend` says what colours mean, `band`
    what a band of that many pixels stands for; pictures that come with axes of their own have neither.
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
            axes.imshow(image, aspect="auto", interpolation="nearest", extent=(0, length, count + 0.5, 0.5))
            axes.set_ylabel(band[0])
            axes.set_yticks([1, *range(10, count + 1, 10)])
            _plain(axes)
        axes.set_title(caption, fontsize=10, loc="left")
    if band is not None:
        all_axes[-1].xaxis.set_major_locator(MaxNLocator(nbins=15, integer=True, steps=[1, 2, 2.4, 5, 6, 10]))
        all_axes[-1].set_xlabel(unit)
    if title:
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    if legend is not None:
        patches = [Patch(color="#{:02x}{:02x}{:02x}".format(*colour), label=label) for label, colour in legend.items()]
        figure.legend(handles=patches, loc="outside lower right", ncols=len(patches), frameon=False, fontsize=9)
    return figure


def learning_curves(curves: Mapping[str, tuple[np.ndarray, np.ndarray]], *, better: str, measure: str = "M1") -> Figure:
    """Scores over minutes of training: name -> (minutes float64 (N,), scores float64 (N,)); the best is labelled.

    `better`: which score is, "higher" or "lower".
    """
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, (minutes, scores)) in enumerate(curves.items()):
        colour = _LINES[i % len(_LINES)]
        axes.plot(minutes, scores, "-", color=colour, lw=1.6, marker="o", ms=3, label=name)
        best = int(np.argmin(scores) if better == "lower" else np.argmax(scores))
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


def curves_by_group(curves: Mapping[str, Any]) -> Figure:
    """Learning curves as marl_sched.train.curves has them: a colour for each group, thin for runs, thick for means."""
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, group) in enumerate(curves["groups"].items()):
        colour = _LINES[i % len(_LINES)]
        for run in group["runs"]:
            axes.plot(run["x"], run["y"], "-", color=colour, lw=0.9, alpha=0.45)
        runs = f"{len(group['runs'])} run{'s' if len(group['runs']) > 1 else ''}"
        axes.plot(group["mean"]["x"], group["mean"]["y"], "-", color=colour, lw=2.4, label=f"{name}, mean of {runs}")
    axes.set_xlabel(
        {"time": f"simulated {curves['unit']}", "seconds": "seconds of training"}.get(curves["x"], curves["x"])
    )
    how = "sampled, in training" if curves["measure"] == "reward_rate" else "on validation instances"
    smooth = f", mean of {curves['smooth']} points" if curves["smooth"] > 1 else ""
    axes.set_ylabel(f"M1 {how}{smooth}")
    _plain(axes)
    axes.grid(color=_FAINT, lw=0.6)
    axes.legend(frameon=False, loc="lower right", fontsize=9)
    return figure


def _conditions(problem: Problem) -> str:
    instances = f"{problem.count} {problem.pad or 'given'} instances"
    return f"{problem.domain.name}, {instances} x {problem.episodes} episodes"


def _view(results: Results) -> str:
    return f"{results.problem.view.kind} view, {100 * results.visible_share:.0f} % seen"


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)


def shares_against_scores(panels: Mapping[str, Mapping[str, Any]], *, measure: str = "M1") -> Figure:
    """M1 against the share of the graph that an agent sees: a panel per caption, a line per scheduler.

    A panel is `{"bound": float, "central": (label, float), "lines": {label: [(share, score, stale, half), ...]}}`;
    `half` of the score's interval is drawn as a bar, points of old data (`stale`) are open and stand beside the line.
    A scheduler has the same colour and shape everywhere;
    the bound and the score of the best scheduler that sees everything are level lines. As most of what matters lies
    close below the bound, the axis of scores is logarithmic in their distance to a level a little above it.
    """
    labels = list(dict.fromkeys(label for panel in panels.values() for label in panel["lines"]))
    looks = {label: (_LINES[i % len(_LINES)], "osD^vP"[i % 6]) for i, label in enumerate(labels)}
    figure = Figure(figsize=(1.5 + 5.4 * len(panels), 6.0), layout="constrained")
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (caption, panel) in zip(all_axes, panels.items(), strict=True):
        for label, points in panel["lines"].items():
            colour, marker = looks[label]
            fresh = sorted((100 * share, score, half) for share, score, stale, half in points if not stale)
            old = [(100 * share, score, half) for share, score, stale, half in points if stale]
            for xyh, look in ((fresh, {"ls": "-", "ms": 5}), (old, {"ls": "none", "ms": 6.5, "mfc": "white"})):
                x, y, half = np.array(xyh).reshape(-1, 3).T
                axes.errorbar(
                    x, y, yerr=half, color=colour, marker=marker, lw=1.5, elinewidth=0.8, capsize=2, **look
                )  # fmt: skip
        name, best = panel["central"]
        axes.axhline(panel["bound"], color=_INK, lw=1.3)
        axes.axhline(best, color=_INK, lw=1.1, ls=":")
        axes.set_title(f"{caption}\nbound {panel['bound']:.4f}, central {name} {best:.4f}", fontsize=10, loc="left")
        axes.set_xlabel("share of the graph that an acting agent sees, percent")
        axes.set_xlim(0, 104)
        _plain(axes)
        axes.grid(color=_FAINT, lw=0.6)
    _stretch_towards(max(panel["bound"] for panel in panels.values()), all_axes)
    all_axes[0].set_ylabel(f"{measure}, stretched towards the bound")
    handles = [Line2D([], [], color=colour, marker=marker, label=label) for label, (colour, marker) in looks.items()]
    handles += [
        Line2D([], [], color=_INK, marker="o", mfc="white", ls="none", label="open: others' sectors seen late"),
        Line2D([], [], color=_INK, marker="|", ms=9, ls="none", label="bars: 95 % of the mean over such instances"),
        Line2D([], [], color=_INK, lw=1.3, label="upper bound"),
        Line2D([], [], color=_INK, lw=1.1, ls=":", label="best that sees everything"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2 * len(panels), frameon=False, fontsize=9)
    return figure


def _stretch_towards(level: float, all_axes: Sequence[Axes]) -> None:
    """Make the shared axis of scores logarithmic in their distance to a level a little above the highest line."""
    low, high = all_axes[0].get_ylim()
    top = level + 0.15 * (high - low)
    ticks = [
        tick for tick in MaxNLocator(nbins=12, steps=[1, 2, 5, 10]).tick_values(low, level) if low <= tick <= level
    ]
    for axes in all_axes:
        axes.set_yscale(
            "function", functions=(lambda y: -np.log(np.maximum(top - y, 1e-9)), lambda z: top - np.exp(-z))
        )
        axes.set_ylim(low, level + 0.015 * (high - low))
        axes.set_yticks(ticks, [f"{tick:.3f}" for tick in ticks])

"""Medians and bands of futures as a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

_COLOURS = ("#2b6a9b", "#e08e0b", "#3c8d5a", "#7d5ba6", "#cb4335", "#5d6d7e")
_DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))
_COLUMNS = 2


def band_figure(
    variants: Mapping[str, Mapping[str, Sequence[Mapping[str, float | None]]]], *, step: str, band: float
) -> Figure:
    """A panel per measure, a line and a band per variant: variant -> measure -> for each step median, low and high."""
    measures = list(next(iter(variants.values())))
    lines = -(-len(measures) // _COLUMNS)
    figure = Figure(figsize=(11.0, 0.7 + 2.3 * lines), layout="constrained")
    panels = figure.subplots(lines, _COLUMNS, squeeze=False).ravel()
    for axes, measure in zip(panels, measures, strict=False):
        for k, (name, bands) in enumerate(variants.items()):
            points = [(i, at) for i, at in enumerate(bands[measure], start=1) if at["median"] is not None]
            if not points:
                continue
            x = [i for i, _ in points]
            low, middle, high = ([at[key] for _, at in points] for key in ("low", "median", "high"))
            colour = _COLOURS[k % len(_COLOURS)]
            axes.plot(x, middle, color=colour, ls=_DASHES[k % len(_DASHES)], marker="o", ms=3, lw=1.6, label=name)
            if len(x) > 1:
                axes.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
            else:
                axes.vlines(x, low, high, color=colour, lw=6, alpha=0.25)
        axes.set_title(f"{measure} per {step}", fontsize=9, loc="left")
        axes.set_xlabel(step, fontsize=8)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.grid(axis="y", color="#e3e8ec", lw=0.6)
    for axes in panels[len(measures) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower left", ncols=min(3, len(labels)), frameon=False, fontsize=8,
        title=f"line: median; band: {100 * band:.0f} percent of the futures", title_fontsize=8, alignment="left",
    )  # fmt: skip
    return figure

"""The timeline of an episode as a figure: what every plane did, and below it who served which plane, crew by crew."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from marl_sched.envs.airme.dynamics import REPAIR
from marl_sched.envs.airme.render import COLOURS, LEGEND, require_timeline

if TYPE_CHECKING:
    from marl_sched.envs.airme.simulator import AirmeSimulator

FRAME = (9.6, 5.4)  # inches of a frame of `rgb_array`, at 100 dots each
_INK, _LINE = "#22303c", "#ffffff"
_NAMED = 30  # planes, from which on only every tenth has its name
_LABELLED = 12  # crews, from which on their jobs are not labelled
_MOST_INCHES = 60.0  # of a figure's height


def episode_figure(
    episodes: Mapping[str, AirmeSimulator], *, title: str = "", until: int | None = None, env_index: int = 0
) -> Figure:
    """One panel per episode, caption -> a simulator that recorded its timeline, on one axis of hours.

    `until`: hours that are drawn, None: as long as the longest episode. Raises InvalidOptionError for a simulator
    without timeline.
    """
    hours = until or max(int(simulator.time[env_index]) for simulator in episodes.values())
    heights = [height for simulator in episodes.values() for height in _heights(simulator, env_index)]
    scale = min(1.0, _MOST_INCHES / sum(heights))
    figure = Figure(figsize=(11.0, 1.3 + scale * sum(heights) + 0.35 * len(episodes)), layout="constrained")
    _panels(figure, episodes, hours, env_index, heights, title)
    return figure


def frame(simulator: AirmeSimulator, env_index: int = 0) -> np.ndarray:
    """The episode so far with labels, on an axis as long as the horizon, uint8 (540, 960, 3): every frame alike."""
    figure = Figure(figsize=FRAME, dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    caption = "   ".join(f"{name} {values[env_index]:.3f}" for name, values in simulator.objectives().items())
    caption = f"hour {int(simulator.time[env_index])}   {caption}"
    _panels(figure, {caption: simulator}, simulator.horizon, env_index, _heights(simulator, env_index), "")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def _heights(simulator: AirmeSimulator, env_index: int) -> tuple[float, float]:
    """Inches of a panel's planes and crews."""
    instance = simulator.instances[env_index]
    return max(0.6, 0.1 * instance.n_planes), max(0.4, 0.17 * instance.n_crews)


def _panels(
    figure: Figure, episodes: Mapping[str, AirmeSimulator], hours: int, env_index: int, heights: Any, title: str
) -> None:
    rows = figure.subplots(2 * len(episodes), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights})
    for k, (caption, simulator) in enumerate(episodes.items()):
        planes, crews = rows[2 * k, 0], rows[2 * k + 1, 0]
        draw_planes(planes, simulator, env_index)
        draw_crews(crews, simulator, hours, env_index)
        planes.set_title(caption, fontsize=10, loc="left")
    last = rows[-1, 0]
    last.set_xlim(0, hours)
    last.xaxis.set_major_locator(MaxNLocator(nbins=15, integer=True, steps=[1, 2, 2.4, 5, 6, 10]))
    last.set_xlabel("hours")
    if title:
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    patches = [Patch(color="#{:02x}{:02x}{:02x}".format(*colour), label=label) for label, colour in LEGEND.items()]
    patches.append(Patch(fill=False, lw=0, label="in a crew's row: the aircraft that it serves"))
    figure.legend(handles=patches, loc="outside lower right", ncols=len(patches), frameon=False, fontsize=9)


def draw_planes(axes: Any, simulator: AirmeSimulator, env_index: int = 0) -> None:
    """A row for every plane, coloured by what it did in each hour so far."""
    require_timeline(simulator)
    instance, hours = simulator.instances[env_index], int(simulator.time[env_index])
    n = instance.n_planes
    status = simulator.state.timeline[env_index, :hours, 1 : n + 1].T
    palette = ListedColormap(np.array([COLOURS[k] for k in sorted(COLOURS)]) / 255)
    if hours:
        axes.imshow(
            status, aspect="auto", interpolation="nearest", extent=(0, hours, n + 0.5, 0.5), cmap=palette, vmin=-0.5,
            vmax=3.5,
        )  # fmt: skip
    axes.set_ylim(n + 0.5, 0.5)
    axes.hlines(np.arange(1, n) + 0.5, 0, simulator.horizon, color=_LINE, lw=0.6)
    shown = np.arange(1, n + 1) if n <= _NAMED else np.array([1, *range(10, n + 1, 10)])
    axes.set_yticks(shown, [_name(simulator, env_index, slot) for slot in shown], fontsize=6 if n > 12 else 7)
    axes.set_ylabel("aircraft", fontsize=8)
    _plain(axes)


def draw_crews(axes: Any, simulator: AirmeSimulator, hours: int, env_index: int = 0) -> None:
    """A row for every crew with its repairs, each labelled with the plane where that is readable on so many hours."""
    require_timeline(simulator)
    n, past = int(simulator.n_agents[env_index]), int(simulator.time[env_index])
    colour = tuple(np.array(COLOURS[REPAIR]) / 255)
    points = 72 * axes.figure.get_figwidth() * 0.85 / hours  # of an hour
    for crew in range(n):
        for begin, end, slot in jobs(simulator.state.jobs[env_index, :past, crew]):
            axes.broken_barh([(begin, end - begin)], (crew - 0.42, 0.84), color=colour, edgecolor=_LINE, lw=0.6)
            label = _name(simulator, env_index, slot)
            if n <= _LABELLED and (end - begin) * points > 3.4 * len(label):
                middle = (begin + end) / 2
                axes.text(middle, crew, label, ha="center", va="center", fontsize=5, color=_INK, clip_on=True)
    axes.set_ylim(n - 0.5, -0.5)
    axes.set_yticks(np.arange(n), [f"crew {crew}" for crew in range(n)] if n <= _NAMED else [str(c) for c in range(n)])
    axes.tick_params(axis="y", labelsize=6 if n > 8 else 7)
    _plain(axes)


def jobs(slots: np.ndarray) -> list[tuple[int, int, int]]:
    """The repairs of one crew from the plane that it served in each hour, (T,): (first hour, hour after, plane)."""
    changes = np.flatnonzero(np.diff(slots, prepend=0, append=0))
    return [(int(a), int(b), int(slots[a])) for a, b in pairwise(changes) if slots[a] > 0]


def _name(simulator: AirmeSimulator, env_index: int, slot: int) -> str:
    names = simulator.instances[env_index].names
    return names[slot - 1] if names else str(slot)


def _plain(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="x", labelsize=8)
    axes.tick_params(axis="y", length=0)

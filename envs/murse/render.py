"""Pictures of MuRSE: a board as text, a round's Gantt chart and the map; images need matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.envs.murse.colours import HUMAN, ROBOT, WAIT
from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.state import NOBODY
from marl_sched.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from marl_sched.envs.murse.simulator import MurseSimulator

FRAME = (9.6, 5.4)  # inches of every picture of an episode, at 100 dots each


def board(simulator: MurseSimulator, env_index: int = 0) -> str:
    """Agents with their commitments of this round, as text; in `plan` mode the times are planned ones."""
    state, instance = simulator.state, simulator.instances[env_index]
    record, tasks = state.rows[env_index], state.tasks[env_index]
    results = "   ".join(f"{name} {values[env_index]:.2f}" for name, values in simulator.objectives().items())
    lines = [f"round {record['round']}   clock {record['clock']:>5}   {results}"]
    for agent in range(instance.n_agents):
        own = [i for i in state.order[env_index, : record["dispatched"]] if tasks["agent"][i] == agent]
        jobs = "  ".join(f"{i + 1}[{tasks['start'][i]},{tasks['finish'][i]})" for i in own)
        mark = "*" if record["acting"] == agent else " "
        lines.append(f"{mark}{'robot' if agent < instance.n_robots else 'human'} {agent}: {jobs or '-'}")
    left = np.flatnonzero(tasks["agent"][: instance.n_tasks] == NOBODY) + 1
    lines.append("unscheduled: " + (" ".join(map(str, left)) or "-"))
    return "\n".join(lines)


def gantt(simulator: MurseSimulator, env_index: int = 0) -> np.ndarray:
    """The Gantt chart of the last ended round, uint8 (540, 960, 3); before a round has ended the map, of that size too.

    Raises ModuleNotFoundError without matplotlib.
    """
    if simulator.state.rows["round"][env_index] == 0:
        return _image(map_figure(simulator, env_index))
    from marl_sched.envs.murse.gantt import gantt_figure

    return _image(gantt_figure({"": schedule(simulator, env_index)}, FRAME))


def episode_figure(episodes: Mapping[str, MurseSimulator], *, title: str = "", until: int | None = None) -> Figure:
    """The last round of several finished episodes, caption -> simulator, on one axis of time.

    `until`: the round to draw, counted from 1; None: the last.
    """
    from marl_sched.envs.murse.gantt import gantt_figure

    chosen = None if until is None else until - 1
    figure = gantt_figure({caption: schedule(simulator, 0, chosen) for caption, simulator in episodes.items()})
    if title:
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    return figure


def map_figure(simulator: MurseSimulator, env_index: int = 0) -> Figure:
    """Where the tasks are and where the agents stand; tasks nearer than the safety distance are joined.

    Tasks that share a place, or lie so close that their numbers would overlap, have one label beside them.
    """
    state, instance = simulator.state, simulator.instances[env_index]
    figure, axes = _figure(*FRAME)
    taken = state.tasks["agent"][env_index, : instance.n_tasks] != NOBODY
    for i, j in np.argwhere(np.triu(instance.near)):
        axes.plot(*instance.locations[[i, j]].T, color=WAIT, linewidth=0.5, zorder=1)
    x, y = instance.locations.T
    axes.scatter(x, y, s=50, c=[WAIT if t else "white" for t in taken], edgecolors="black", zorder=2)
    for (a, b), names in _labels(instance.locations).items():
        axes.annotate(
            names, (a, b), xytext=(5, 4), textcoords="offset points", fontsize=7, zorder=3,
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.4},
        )  # fmt: skip
    for agent, last in enumerate(state.agents["last_task"][env_index, : instance.n_agents]):
        stand = instance.locations[last] if last >= 0 else np.zeros(2)
        colour = ROBOT if agent < instance.n_robots else HUMAN
        axes.scatter(*stand, s=0)  # an annotation alone does not widen the axes
        axes.annotate(
            str(agent), stand, xytext=(-6 - 11 * (agent % 12), -11 - 11 * (agent // 12)), textcoords="offset points",
            fontsize=6, ha="center", va="center", bbox={"facecolor": colour, "edgecolor": "none", "pad": 1.6}, zorder=4,
        )  # fmt: skip
    axes.margins(0.08)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(
        "map: tasks (grey: taken) and agents where they stand (blue robots, amber humans); lines: too close to overlap",
        fontsize=8,
    )
    axes.set_xlabel("x", fontsize=8)
    axes.set_ylabel("y", fontsize=8)
    return figure


def _labels(locations: np.ndarray) -> dict[tuple[float, float], str]:
    """Labels by their place: the tasks of a place, and of places within a fiftieth of the map, together."""
    span = max(float(np.ptp(locations, axis=0).max()), 1e-9)
    groups: list[tuple[np.ndarray, list[int]]] = []
    for i, place in enumerate(locations):
        near = next((tasks for where, tasks in groups if np.abs(where - place).max() <= span / 50), None)
        if near is None:
            groups.append((place, [i + 1]))
        else:
            near.append(i + 1)
    return {(float(a), float(b)): ",".join(map(str, tasks)) for (a, b), tasks in groups}


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format of the path's suffix, beside and renamed."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def _image(figure: Figure) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(100)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()

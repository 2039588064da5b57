"""A round of MuRSE as a moving picture: agents on the map above, its Gantt chart with the present time below."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from marl_sched.envs.murse.colours import HUMAN, LATE, ROBOT, WAIT
from marl_sched.envs.murse.gantt import draw_chart, is_late, is_robot, last_time
from marl_sched.envs.murse.schedule import schedule

if TYPE_CHECKING:
    from marl_sched.envs.murse.simulator import MurseSimulator

_INK, _OPEN = "#22303c", "#ffffff"
_APART = 0.075  # of the map's size, between tasks that share a place
_BELOW = 0.085  # of the map's size, how far below its task an agent is drawn


def round_frames(simulator: MurseSimulator, env_index: int = 0, *, count: int = 80) -> Iterator[np.ndarray]:
    """The last ended round of a row in `count` pictures at equal steps of time, uint8 (600, 900, 3) each.

    An agent stands where it works and moves in a straight line from the end of one task to the start of its next.
    Tasks are white until somebody works on them, in its colour meanwhile, grey afterwards, with a red rim if late;
    those that share a place are drawn side by side. Agents without a task wait at the left.
    Raises InvalidOptionError if no round has ended.
    """
    data = schedule(simulator, env_index)
    figure = Figure(figsize=(9.0, 6.0), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, gridspec_kw={"height_ratios": [3, 2]})
    places, span = _places(data)
    draw_chart(below, data)
    now = below.axvline(0.0, color=LATE, lw=1.4, zorder=7)
    tasks = above.scatter(*places.T, s=190, edgecolors=_INK, zorder=2)
    for number, at in enumerate(places, start=1):
        above.annotate(str(number), at, fontsize=7, ha="center", va="center", color=_INK, zorder=3)
    agents = [
        above.scatter([], [], s=110, marker="s" if is_robot(data, agent) else "o", zorder=5, edgecolors=_INK,
                      color=ROBOT if is_robot(data, agent) else HUMAN)
        for agent in range(len(data["agents"]))
    ]  # fmt: skip
    _frame_map(above, places, span)
    for time in np.linspace(0, last_time(data), count):
        tasks.set_facecolors([_colour(data, task, time) for task in range(len(places))])
        tasks.set_edgecolors([_rim(data, task, time) for task in range(len(places))])
        for agent, mark in enumerate(agents):
            mark.set_offsets(_position(data, places, agent, time) + np.array([0.0, -_BELOW * span]))
        now.set_xdata([time, time])
        done = sum(job["finish"] <= time for job in data["dispatch"])
        above.set_title(
            f"round {data['round'] + 1}, time {time:.0f}: {done} of {len(places)} tasks done "
            "(squares: robots, circles: humans; red rim: late)",
            fontsize=9, loc="left",
        )  # fmt: skip
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def _frame_map(axes: Any, places: np.ndarray, span: float) -> None:
    low, high = places.min(axis=0) - 0.2 * span, places.max(axis=0) + 0.15 * span
    axes.set(xlim=(low[0] - 0.15 * span, high[0]), ylim=(low[1], high[1]))
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x", fontsize=8)
    axes.set_ylabel("y", fontsize=8)


def _places(data: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Where the tasks are drawn, float64 (N, 2), those of one place side by side; and the size of the map."""
    places = np.array([task["location"] for task in data["tasks"]], float)
    span = max(float(np.ptp(places, axis=0).max()), 1.0)
    _, group = np.unique(places, axis=0, return_inverse=True)
    for members in (np.flatnonzero(group.ravel() == g) for g in range(group.max() + 1)):
        places[members, 0] += (np.arange(len(members)) - (len(members) - 1) / 2) * _APART * span
    return places, span


def _job(data: dict[str, Any], task: int) -> dict[str, Any] | None:
    return next((job for job in data["dispatch"] if job["task"] == task + 1), None)


def _colour(data: dict[str, Any], task: int, time: float) -> str:
    job = _job(data, task)
    if job is None or time < job["start"]:
        return _OPEN
    if time >= job["finish"]:
        return WAIT
    return ROBOT if is_robot(data, job["agent"]) else HUMAN


def _rim(data: dict[str, Any], task: int, time: float) -> str:
    job = _job(data, task)
    return LATE if job is not None and time >= job["finish"] and is_late(data, job) else _INK


def _position(data: dict[str, Any], places: np.ndarray, agent: int, time: float) -> np.ndarray:
    """Where an agent stands at a time, float64 (2,); before its first task at that task, without any at the left."""
    jobs = sorted((job for job in data["dispatch"] if job["agent"] == agent), key=lambda job: job["start"])
    if not jobs:
        low, high = places.min(axis=0), places.max(axis=0)
        return np.array([low[0] - 0.2 * (high[0] - low[0] + 1), high[1] - 0.1 * agent * (high[1] - low[1] + 1)])
    times = [moment for job in jobs for moment in (job["start"], job["finish"])]
    stands = np.repeat(places[[job["task"] - 1 for job in jobs]], 2, axis=0)
    return np.array([np.interp(time, times, stands[:, axis]) for axis in (0, 1)])

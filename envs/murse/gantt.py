"""Gantt charts of schedules: one or more on a shared axis of time, readable with ten tasks and with hundreds."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from marl_sched.envs.murse.colours import HUMAN, LATE, ROBOT, WAIT
from marl_sched.envs.murse.validation import validate

_INK = "#22303c"
_ARROWS = 40  # tasks, from which on waits are not drawn
_TICK_LABELS = 40  # tasks, from which on only missed deadlines have their number
_LATER = 1.25  # of the last finish: deadlines up to there are drawn
_WIDEST, _TALLEST = 40.0, 60.0  # inches of a figure


def gantt_figure(schedules: Mapping[str, dict[str, Any]], size: tuple[float, float] | None = None) -> Figure:
    """A panel for each schedule, caption -> its data (marl_sched.envs.murse.schedule), on one axis of time.

    Agents are rows. Waits are arrows behind the bars and deadlines ticks in the row of the task; where a chart has more
    than 40 tasks waits are left out and only missed deadlines have numbers. `size` in inches; None: as the data need.
    """
    rows = [max(1, len(data["agents"])) for data in schedules.values()]
    widest = max(_inches(data) for data in schedules.values())
    height = min(_TALLEST, 0.9 + sum(0.55 + 0.36 * count for count in rows))
    figure = Figure(figsize=size or (widest, height), layout="constrained")
    panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": rows})[:, 0]
    arrows = False
    for axes, (caption, data) in zip(panels, schedules.items(), strict=True):
        axes.set_title(_title(caption, data, figure.get_figwidth()), fontsize=9, loc="left")
        arrows = _panel(axes, data, figure.get_figwidth(), _span(schedules)) or arrows
    panels[-1].set_xlim(0, 1.02 * _span(schedules))
    panels[-1].set_xlabel("time units", fontsize=9)
    figure.legend(handles=_legend(schedules, arrows), loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    return figure


def draw_chart(axes: Any, data: dict[str, Any]) -> None:
    """The chart of one schedule (marl_sched.envs.murse.schedule) on given axes, without title and legend."""
    span = last_time(data)
    _panel(axes, data, axes.figure.get_figwidth(), span)
    axes.set_xlim(0, 1.02 * span)
    axes.set_xlabel("time units", fontsize=9)


def last_time(data: dict[str, Any]) -> int:
    """Up to where a schedule's chart reaches: its last finish, at least 1, or a deadline that is not much later."""
    return _span({"": data})


def _panel(axes: Any, data: dict[str, Any], width: float, span: int) -> bool:
    """The bars, deadlines and waits of a schedule, a row for each agent; whether there is any wait to see."""
    _bars(axes, data, width, span)
    _deadlines(axes, data, span)
    arrows = len(data["tasks"]) <= _ARROWS and _waits(axes, data)
    axes.set_yticks(range(len(data["agents"])), data["agents"], fontsize=8)
    axes.set_ylim(len(data["agents"]) - 0.4, -0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_axisbelow(True)
    axes.grid(axis="x", color="#e3e8ec", lw=0.6)
    return arrows


def _span(schedules: Mapping[str, dict[str, Any]]) -> int:
    """The last finish of all schedules, at least 1, or a deadline that is not much later."""
    last = max([1, *(job["finish"] for data in schedules.values() for job in data["dispatch"])])
    deadlines = [
        task["deadline"] for data in schedules.values() for task in data["tasks"] if task["deadline"] is not None
    ]
    return max([last, *(one for one in deadlines if one <= _LATER * last)])


def _inches(data: Mapping[str, Any]) -> float:
    """Width at which the bars of the busiest agent can be told apart."""
    counts = [sum(job["agent"] == agent for job in data["dispatch"]) for agent in range(len(data["agents"]))]
    return min(_WIDEST, max(9.6, 1.5 + 0.42 * max(counts, default=0)))


def _title(caption: str, data: Mapping[str, Any], width: float) -> str:
    verdict = "feasible" if data["feasible"] else "infeasible: " + "; ".join(validate(data).given_broken[:3])
    if not data["feasible"] and not validate(data).given_broken:
        verdict = "infeasible"
    parts = [caption, f"round {data['round'] + 1}, makespan {data['makespan']}, {verdict}"]
    return "\n".join(textwrap.wrap(": ".join(part for part in parts if part), int(13 * width)))


def is_robot(data: Mapping[str, Any], agent: int) -> bool:
    """Whether an agent of a schedule is a robot."""
    robots = data.get("robots")
    return bool(agent < robots) if robots is not None else str(data["agents"][agent]).startswith("robot")


def is_late(data: Mapping[str, Any], job: Mapping[str, Any]) -> bool:
    """Whether a dispatched task ends after its deadline."""
    deadline = data["tasks"][job["task"] - 1]["deadline"]
    return deadline is not None and job["finish"] > deadline


def _bars(axes: Any, data: Mapping[str, Any], width: float, span: int) -> None:
    for job in data["dispatch"]:
        late = is_late(data, job)
        axes.barh(
            job["agent"],
            job["duration"],
            left=job["start"],
            height=0.62,
            color=ROBOT if is_robot(data, job["agent"]) else HUMAN,
            edgecolor=LATE if late else "white",
            linewidth=1.8 if late else 0.8,
            zorder=3,
        )
        points = 72 * (width - 1.5) * job["duration"] / span
        label = str(job["task"])
        size = min(8.0, points / (0.62 * len(label) + 0.3))
        if size >= 4.0:
            middle = job["start"] + job["duration"] / 2
            axes.text(middle, job["agent"], label, ha="center", va="center", fontsize=size, color=_INK, zorder=4)


def _deadlines(axes: Any, data: Mapping[str, Any], span: int) -> None:
    """A tick at each deadline on the axis, in its task's row; its number above it where there is room."""
    for job in data["dispatch"]:
        deadline = data["tasks"][job["task"] - 1]["deadline"]
        if deadline is None or deadline > span:
            continue
        late = is_late(data, job)
        colour = LATE if late else _INK
        axes.plot([deadline] * 2, [job["agent"] - 0.44, job["agent"] + 0.34], color=colour, lw=1.4, zorder=5)
        if late or len(data["tasks"]) <= _TICK_LABELS:
            axes.text(
                deadline, job["agent"] - 0.45, str(job["task"]), fontsize=6, ha="center", va="bottom", color=colour,
                zorder=6,
            )  # fmt: skip


def _waits(axes: Any, data: Mapping[str, Any]) -> bool:
    """An arrow, behind the bars, from each task that another one waits for; whether there is any."""
    rows = {job["task"]: job for job in data["dispatch"]}
    drawn = False
    for job in rows.values():
        for wait in data["tasks"][job["task"] - 1]["waits"]:
            before = rows.get(wait["after"])
            if before is not None:
                drawn = True
                axes.annotate(
                    "",
                    xy=(job["start"], job["agent"]),
                    xytext=(before["finish"], before["agent"]),
                    arrowprops={"arrowstyle": "->", "color": WAIT, "lw": 0.9, "shrinkA": 0, "shrinkB": 0},
                    zorder=2,
                )
    return drawn


def _legend(schedules: Mapping[str, dict[str, Any]], arrows: bool) -> list[Any]:
    handles: list[Any] = []
    kinds = {is_robot(data, agent) for data in schedules.values() for agent in range(len(data["agents"]))}
    if True in kinds:
        handles.append(Patch(color=ROBOT, label="robot"))
    if False in kinds:
        handles.append(Patch(color=HUMAN, label="human"))
    deadlines = [(data, job) for data in schedules.values() for job in data["dispatch"]]
    if any(data["tasks"][job["task"] - 1]["deadline"] is not None for data, job in deadlines):
        handles.append(Line2D([], [], color=_INK, marker="|", ms=9, mew=1.4, ls="none", label="deadline of the task"))
    if any(is_late(data, job) for data, job in deadlines):
        handles.append(Patch(facecolor="white", edgecolor=LATE, lw=1.8, label="task ends after its deadline"))
    if arrows:
        handles.append(Line2D([], [], color=WAIT, marker=">", ms=5, lw=1, label="waits for"))
    if any(len(data["tasks"]) > _ARROWS for data in schedules.values()):
        handles.append(Patch(fill=False, lw=0, label=f"waits are not drawn beyond {_ARROWS} tasks"))
    return handles

"""Pictures of MuRSE: a board as text, a round's Gantt chart and the map; images need matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.state import NOBODY
from marl_sched.envs.murse.validation import validate
from marl_sched.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from marl_sched.envs.murse.simulator import MurseSimulator

ROBOT, HUMAN, LATE, WAIT = "#56a0d3", "#f4b040", "#cb4335", "#7f8c8d"


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
    """The Gantt chart of the last ended round as an image, uint8 (height, width, 3).

    Before a round has ended it shows the map. Raises ModuleNotFoundError without matplotlib.
    """
    if simulator.state.rows["round"][env_index] == 0:
        return _image(map_figure(simulator, env_index))
    return _image(gantt_figure(schedule(simulator, env_index)))


def gantt_figure(data: dict[str, Any]) -> Figure:
    """The Gantt chart of a schedule's data: agents as rows, deadlines as lines, waits as arrows, violations red."""
    figure, axes = _figure(9.0, 1.2 + 0.5 * len(data["agents"]))
    rows = {job["task"]: job for job in data["dispatch"]}
    late = {task for task in rows if _is_late(data, rows[task])}
    for task, job in rows.items():
        colour = ROBOT if data["agents"][job["agent"]].startswith("robot") else HUMAN
        edge = LATE if task in late else "white"
        axes.barh(job["agent"], job["duration"], left=job["start"], color=colour, edgecolor=edge, linewidth=2)
        axes.text(job["start"] + job["duration"] / 2, job["agent"], str(task), ha="center", va="center", fontsize=8)
    for task, job in rows.items():
        deadline = data["tasks"][task - 1]["deadline"]
        if deadline is not None:
            low, high = job["agent"] - 0.45, job["agent"] + 0.45
            axes.plot([deadline, deadline], [low, high], color=LATE if task in late else "black", linewidth=1.5)
            axes.text(deadline, low, f"{task}", fontsize=7, ha="center", va="bottom")
        for wait in data["tasks"][task - 1]["waits"]:
            if wait["after"] in rows:
                before = rows[wait["after"]]
                axes.annotate(
                    "",
                    xy=(job["start"], job["agent"]),
                    xytext=(before["finish"], before["agent"]),
                    arrowprops={"arrowstyle": "->", "color": WAIT, "linestyle": "dashed"},
                )
    verdict = "feasible" if data["feasible"] else "infeasible: " + "; ".join(validate(data).given_broken[:2])
    axes.set_title(f"round {data['round'] + 1}, makespan {data['makespan']}, {verdict}"[:110], fontsize=9)
    axes.set_yticks(range(len(data["agents"])), data["agents"])
    axes.invert_yaxis()
    axes.set_xlabel("time")
    return figure


def _is_late(data: dict[str, Any], job: dict[str, Any]) -> bool:
    deadline = data["tasks"][job["task"] - 1]["deadline"]
    return deadline is not None and job["finish"] > deadline


def map_figure(simulator: MurseSimulator, env_index: int = 0) -> Figure:
    """Where the tasks are and where the agents stand; tasks nearer than the safety distance are joined."""
    state, instance = simulator.state, simulator.instances[env_index]
    figure, axes = _figure(5.0, 5.0)
    taken = state.tasks["agent"][env_index, : instance.n_tasks] != NOBODY
    for i, j in np.argwhere(np.triu(instance.near)):
        axes.plot(*instance.locations[[i, j]].T, color=WAIT, linewidth=0.5, zorder=1)
    x, y = instance.locations.T
    axes.scatter(x, y, s=160, c=[WAIT if t else "white" for t in taken], edgecolors="black", zorder=2)
    places: dict[tuple[float, float], list[str]] = {}
    for i, (a, b) in enumerate(instance.locations):
        places.setdefault((float(a), float(b)), []).append(str(i + 1))
    for (a, b), names in places.items():
        axes.text(a, b, ",".join(names), ha="center", va="center", fontsize=7, zorder=3)
    for agent, last in enumerate(state.agents["last_task"][env_index, : instance.n_agents]):
        stand = instance.locations[last] if last >= 0 else np.zeros(2)
        colour = ROBOT if agent < instance.n_robots else HUMAN
        axes.scatter(stand[0] + 0.12 * (agent + 1), stand[1] - 0.2, s=40, c=colour, marker="s", zorder=4)
    axes.set_title("tasks (grey: taken) and agents (blue robots, amber humans)", fontsize=8)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format of the path's suffix, beside and renamed."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _image(figure: Figure) -> np.ndarray:
    canvas: Any = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()

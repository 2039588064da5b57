"""A round's schedule as plain data: what `marl_sched.envs.murse.validation` checks and what pictures are drawn from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.state import NOBODY
from marl_sched.errors import InvalidOptionError
from marl_sched.files import write_json

if TYPE_CHECKING:
    from marl_sched.envs.murse.simulator import MurseSimulator

SCHEMA = 1


def schedule(simulator: MurseSimulator, env_index: int = 0, round_index: int | None = None) -> dict[str, Any]:
    """An ended round of one row, the last one by default, with the constraints that it has to keep.

    `dispatch` lists the tasks, counted from 1, in order of dispatch with agent, true duration and true times; in
    `online` mode also the time at which the agent committed, before which the task cannot start. Raises
    InvalidOptionError if the round has not ended.
    """
    ended = int(simulator.state.rows["round"][env_index])
    chosen = ended - 1 if round_index is None else round_index
    if not 0 <= chosen < ended:
        raise InvalidOptionError(f"round {chosen}: {ended} rounds have ended in row {env_index}")
    instance, result = simulator.instances[env_index], simulator.state.rounds[env_index, chosen]
    executed = simulator.state.executed[env_index, chosen, : instance.n_tasks]
    dispatched = [i for i in np.argsort(executed["position"], kind="stable") if executed["agent"][i] != NOBODY]
    ahead = instance.waits_by_task()
    tasks, agents = instance.called
    names = ("agent", "start", "finish", *(("committed",) if simulator.mode == "online" else ()))
    return {
        "schema": SCHEMA,
        "env": "murse",
        "round": chosen,
        "mode": simulator.mode,
        "agents": agents,
        "robots": instance.n_robots,
        "proximity": instance.proximity,
        "safety_distance": float(instance.safety_distance),
        "longest": int(result["longest"]),
        "tasks": [
            {
                **({"name": tasks[i]} if instance.task_names else {}),
                "deadline": None if instance.deadlines[i] == NO_DEADLINE else int(instance.deadlines[i]),
                "waits": [{"after": j + 1, "time": w} for j, w in ahead[i]],
                "location": instance.locations[i].tolist(),
                "eligible": np.flatnonzero(instance.eligible[i]).tolist(),
            }
            for i in range(instance.n_tasks)
        ],
        "dispatch": [
            {
                "task": int(i) + 1,
                "duration": int(executed["finish"][i] - executed["start"][i]),
                **{name: int(executed[name][i]) for name in names},
            }
            for i in dispatched
        ],
        "feasible": bool(result["feasible"]),
        "makespan": int(result["makespan"]),
    }


def save_schedule(
    simulator: MurseSimulator, path: str | Path, env_index: int = 0, round_index: int | None = None
) -> None:
    """Write `schedule` as JSON, beside and renamed."""
    write_json(path, schedule(simulator, env_index, round_index))


def save_schedules(simulator: MurseSimulator, env_index: int, path: Path) -> list[Path]:
    """Write every ended round of a row to `path` with the round's number and .json behind it; the files written."""
    paths = []
    for k in range(int(simulator.state.rows["round"][env_index])):
        paths.append(path.with_name(f"{path.name}-round{k}.json"))
        save_schedule(simulator, paths[-1], env_index, k)
    return paths

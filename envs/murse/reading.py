"""Reading MuRSE instances from our JSON; the field and what was expected are named in every complaint."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE, MurseInstance
from marl_sched.envs.murse.learning import CURVE
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.files import read_json
from marl_sched.structs import convert

_Natural = Annotated[int, msgspec.Meta(ge=0, lt=2**31, description="an integer in [0, 2**31)")]
_Count = Annotated[int, msgspec.Meta(ge=1, lt=2**31, description="an integer in [1, 2**31)")]
_Positive = Annotated[float, msgspec.Meta(gt=0, description="a number > 0")]
_Magnitude = Annotated[float, msgspec.Meta(ge=0, description="a number >= 0")]


class _Curve(msgspec.Struct, forbid_unknown_fields=True):
    c: _Magnitude
    c_std: _Magnitude
    k: _Magnitude
    k_std: _Magnitude
    beta: _Magnitude
    beta_std: _Magnitude


class _Wait(msgspec.Struct, forbid_unknown_fields=True):
    after: _Count
    time: _Natural


class _Task(msgspec.Struct, forbid_unknown_fields=True):
    robots: list[_Natural | None]
    humans: list[_Curve]
    location: tuple[float, float]
    deadline: _Natural | None = None
    waits: list[_Wait] = []
    weight: _Magnitude = 1.0
    name: str | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    schema: Annotated[Literal[1, 2], msgspec.Meta(description="1 or 2")]
    env: Literal["murse"]
    n_robots: _Natural
    n_humans: _Natural
    tasks: Annotated[list[_Task], msgspec.Meta(min_length=1)]
    n_rounds: _Count = 1
    proximity: Literal["distance", "location", "none"] = "distance"
    safety_distance: _Magnitude = 1.0
    learning: Literal["none", "one_shot", "exponential"] = "exponential"
    durations: Literal["deterministic", "stochastic"] = "deterministic"
    duration_range: tuple[_Count, _Count] = (15, 100)
    map_width: _Positive = 5.0
    agent_names: list[str] = []


def load(path: str | Path) -> MurseInstance:
    """Read an instance; InvalidFileError names the file, the field and what was expected."""
    return decode(read_json(path), path)


def decode(data: Any, where: str | Path) -> MurseInstance:
    """The instance that `MurseInstance.as_json` wrote; InvalidFileError names `where` and the field."""
    file = convert(data, _File, where)
    for i, task in enumerate(file.tasks):
        for name, count in (("robots", file.n_robots), ("humans", file.n_humans)):
            if len(getattr(task, name)) != count:
                raise InvalidFileError(where, f"tasks[{i}].{name}", f"{count} entries", len(getattr(task, name)))
    try:
        return _instance(file)
    except InvalidOptionError as error:
        raise InvalidFileError(where, "", f"a possible problem ({error})") from error


def _duration(schema: int, written: int | None) -> int:
    """A robot's duration: null is ineligible, and in files of schema 1 also 0."""
    return INELIGIBLE if written is None or (schema == 1 and written == 0) else written


def _instance(file: _File) -> MurseInstance:
    tasks, n = file.tasks, len(file.tasks)
    curves = [[[getattr(curve, name) for name in CURVE] for curve in task.humans] for task in tasks]
    return MurseInstance(
        robot_durations=np.array(
            [[_duration(file.schema, d) for d in task.robots] for task in tasks], np.int64
        ).reshape(n, file.n_robots),
        curves=np.array(curves, np.float64).reshape(n, file.n_humans, len(CURVE)),
        deadlines=np.array([NO_DEADLINE if task.deadline is None else task.deadline for task in tasks]),
        waits=np.array([(i, w.after - 1, w.time) for i, task in enumerate(tasks) for w in task.waits], np.int64),
        locations=np.array([task.location for task in tasks]),
        weights=np.array([task.weight for task in tasks]),
        proximity=file.proximity,
        safety_distance=file.safety_distance,
        learning=file.learning,
        durations=file.durations,
        duration_range=file.duration_range,
        n_rounds=file.n_rounds,
        map_width=file.map_width,
        task_names=tuple(task.name for task in tasks if task.name is not None),
        agent_names=tuple(file.agent_names),
    )

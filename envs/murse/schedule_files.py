"""Schedules of MuRSE as `marl-sched schedule` and `validate` take them; see marl_sched.planning.Schedules."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec

from marl_sched.envs.murse.explaining import explain
from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.validation import validate
from marl_sched.errors import InvalidFileError
from marl_sched.structs import convert

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from marl_sched.envs.murse.simulator import MurseSimulator

_Natural = Annotated[int, msgspec.Meta(ge=0, description="an integer >= 0")]
_Count = Annotated[int, msgspec.Meta(ge=1, description="an integer >= 1")]


class _Wait(msgspec.Struct):
    after: _Count
    time: _Natural


class _Task(msgspec.Struct):
    deadline: _Natural | None
    waits: list[_Wait]
    location: tuple[float, float]
    eligible: list[_Natural]


class _Job(msgspec.Struct):
    task: _Count
    agent: _Natural
    start: _Natural
    finish: _Natural
    duration: _Natural
    committed: _Natural = 0


class _Schedule(msgspec.Struct):
    schema: Annotated[Literal[1], msgspec.Meta(description="1")]
    env: Literal["murse"]
    round: _Natural
    agents: Annotated[list[str], msgspec.Meta(min_length=1)]
    proximity: Literal["distance", "location", "none"]
    safety_distance: float
    longest: _Natural
    tasks: Annotated[list[_Task], msgspec.Meta(min_length=1)]
    dispatch: list[_Job]
    feasible: bool
    makespan: _Natural


class MurseSchedules:
    """See marl_sched.planning.Schedules."""

    def of(self, simulator: MurseSimulator, env_index: int, round_index: int) -> dict[str, Any]:
        """The schedule of an ended round as plain data."""
        return schedule(simulator, env_index, round_index)

    def decode(self, data: Any, where: str | Path) -> dict[str, Any]:
        """The data of a schedule, checked field by field; InvalidFileError names the field."""
        checked = convert(data, _Schedule, where)
        for i, job in enumerate(checked.dispatch):
            if job.task > len(checked.tasks):
                raise InvalidFileError(where, f"dispatch[{i}].task", f"a task in 1..{len(checked.tasks)}", job.task)
            if job.agent >= len(checked.agents):
                expected = f"an agent in 0..{len(checked.agents) - 1}"
                raise InvalidFileError(where, f"dispatch[{i}].agent", expected, job.agent)
        for i, task in enumerate(checked.tasks):
            for k, wait in enumerate(task.waits):
                if wait.after > len(checked.tasks):
                    expected = f"a task in 1..{len(checked.tasks)}"
                    raise InvalidFileError(where, f"tasks[{i}].waits[{k}].after", expected, wait.after)
        return dict(data)

    def problems(self, data: Mapping[str, Any]) -> list[str]:
        """What is wrong with a schedule: constraints that its times break, and where it says otherwise than is so."""
        verdict = validate(data)
        found = list(verdict.given_broken)
        if not found and verdict.differing:
            late = ", ".join(map(str, verdict.differing))
            found.append(f"tasks {late}: start later than they could in this order of dispatch")
        makespan = max((job["finish"] for job in data["dispatch"]), default=0)
        if makespan != data["makespan"]:
            found.append(f"makespan: the file says {data['makespan']}, its times say {makespan}")
        if data["feasible"] and not verdict.feasible:
            found.append("feasible: the file says so, and it is not")
        return found

    def explain(self, data: Mapping[str, Any]) -> list[str]:
        """Why a schedule is infeasible, in sentences; empty if it is feasible."""
        return explain(data)

    def summary(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """What a table says of a schedule."""
        return {"feasible": data["feasible"], "makespan": data["makespan"]}

    def rows(self, data: Mapping[str, Any]) -> tuple[list[str], list[list[Any]]]:
        """Headings and a row for each dispatched task, by start; None where there is nothing to say."""
        rows = []
        for job in sorted(data["dispatch"], key=lambda job: (job["start"], job["finish"], job["task"])):
            task = data["tasks"][job["task"] - 1]
            deadline = task["deadline"]
            rows.append(
                [
                    job["task"],
                    task.get("name"),
                    data["agents"][job["agent"]],
                    job["start"],
                    job["finish"],
                    job["duration"],
                    deadline,
                    None if deadline is None else max(0, job["finish"] - deadline),
                ]
            )
        return ["task", "name", "agent", "start", "finish", "duration", "deadline", "late by"], rows

    def figure(self, schedules: Mapping[str, Mapping[str, Any]]) -> Figure:
        """The Gantt charts of schedules by their captions, on one axis of time; needs matplotlib."""
        from marl_sched.envs.murse.gantt import gantt_figure

        return gantt_figure({caption: dict(data) for caption, data in schedules.items()})


SCHEDULES = MurseSchedules()

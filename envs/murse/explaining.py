"""Why a schedule is feasible or not, in sentences: which constraint fails, and what leads to it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from marl_sched.envs.murse.validation import validate

_LINKS = 8  # of a chain of causes that is told
Schedule = Mapping[str, Any]


def explain(schedule: Schedule) -> list[str]:
    """A sentence for each constraint that fails, and why; empty for a schedule that is feasible as its times say.

    A late task is traced back along what made it start when it did: a wait, its agent's previous task, a task that
    was too close, the time at which its agent committed.
    """
    jobs = {job["task"]: job for job in schedule["dispatch"]}
    sentences = list(_left_out(schedule, jobs))
    late = {}
    for task, job in jobs.items():
        deadline = schedule["tasks"][task - 1]["deadline"]
        if deadline is not None and job["finish"] > deadline:
            late[task] = (
                f"{named(schedule, task)} ends at {job['finish']}, {job['finish'] - deadline} after its deadline "
                f"{deadline}: {_why(schedule, jobs, job)}"
            )
    sentences += [late[task] for task in sorted(late, key=lambda task: jobs[task]["finish"])]
    told = [f"task {task}: finishes at {jobs[task]['finish']} after its deadline" for task in late]
    told += [f"task {task}: dispatched 0 times" for task in range(1, len(schedule["tasks"]) + 1) if task not in jobs]
    rest = [line for line in validate(schedule).given_broken if not line.startswith(tuple(told))]
    return sentences + rest


def named(schedule: Schedule, task: int) -> str:
    """A task, counted from 1, as people call it: `task 3 (drill)`."""
    name = schedule["tasks"][task - 1].get("name")
    return f"task {task}" if name is None else f"task {task} ({name})"


def _left_out(schedule: Schedule, jobs: Mapping[int, Any]) -> Iterator[str]:
    """Why tasks were never done, as far as the schedule tells."""
    for task, data in enumerate(schedule["tasks"], start=1):
        if task in jobs:
            continue
        missing = [named(schedule, wait["after"]) for wait in data["waits"] if wait["after"] not in jobs]
        why = f"it waits for {', '.join(missing)}, not done either" if missing else "nobody took it"
        yield f"{named(schedule, task)} was not done: {why}"


def _why(schedule: Schedule, jobs: Mapping[int, Any], job: Mapping[str, Any]) -> str:
    """The chain of causes of a task's start, back to time 0."""
    agent = schedule["agents"][job["agent"]]
    told = [f"{agent} does it in {job['duration']} from {job['start']} on"]
    for _ in range(_LINKS):
        if job["start"] == 0:
            return ", ".join(told)
        words, before = _cause(schedule, jobs, job)
        told.append(words)
        if before is None:
            return ", ".join(told)
        job = before
    return ", ".join([*told, "and so on"])


def _cause(schedule: Schedule, jobs: Mapping[int, Any], job: Mapping[str, Any]) -> tuple[str, Mapping[str, Any] | None]:
    """What makes a task start when it does, and the task in question, if it is one."""
    start, place = job["start"], schedule["dispatch"].index(job)
    for wait in schedule["tasks"][job["task"] - 1]["waits"]:
        before = jobs.get(wait["after"])
        if before is not None and before["finish"] + wait["time"] == start:
            lag = f" and {wait['time']} must pass" if wait["time"] else ""
            return f"since {named(schedule, before['task'])} ends at {before['finish']}{lag}", before
    for before in schedule["dispatch"][:place]:
        if before["finish"] != start:
            continue
        if before["agent"] == job["agent"]:
            return f"since its agent is at {named(schedule, before['task'])} until {start}", before
        if _near(schedule, before["task"], job["task"]):
            return f"since {named(schedule, before['task'])}, too close to overlap, ends at {start}", before
    if job.get("committed") == start:
        return f"since its agent chose it no earlier than {start}", None
    return f"since it was planned for {start}", None


def _near(schedule: Schedule, a: int, b: int) -> bool:
    if schedule["proximity"] == "none":
        return False
    here, there = (schedule["tasks"][task - 1]["location"] for task in (a, b))
    return (
        here == there if schedule["proximity"] == "location" else math.dist(here, there) <= schedule["safety_distance"]
    )

"""An independent check of a MuRSE schedule's JSON: it shares no code with the simulator.

`validate` takes a schedule as `marl_sched.envs.murse.schedule` writes it. From the dispatch order and the true
durations alone it computes every start as a longest path, and separately it holds the given times against every
constraint. Both verdicts and their agreement are reported. Standard library only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from typing import Any


@dataclass(frozen=True)
class Verdict:
    """What the validator found.

    Attributes:
        feasible: whether the schedule, timed anew, keeps every constraint.
        starts: task (from 1) -> earliest start; empty if tasks must precede each other.
        makespan: latest finish of the new times.
        broken: constraints that the new times break, in words.
        given_broken: constraints that the given times break, in words.
        differing: tasks whose given start is not the earliest.
    """

    feasible: bool
    starts: dict[int, int]
    makespan: int
    broken: list[str]
    given_broken: list[str]
    differing: list[int]


def validate(schedule: Mapping[str, Any]) -> Verdict:
    """Confirm or refute a schedule; KeyError or TypeError if it is not one."""
    rows = schedule["dispatch"]
    structure = list(_structure_problems(schedule))
    given = {row["task"]: row["start"] for row in rows}
    starts: dict[int, int] = {}
    if len(given) == len(rows):
        starts = _longest_paths(schedule)
    if not starts and rows:
        return Verdict(False, {}, 0, [*structure, "order: tasks must precede each other"], structure, sorted(given))
    finishes = {row["task"]: starts[row["task"]] + row["duration"] for row in rows}
    broken = structure + list(_broken(schedule, starts))
    given_broken = structure + list(_broken(schedule, given))
    given_broken += [
        f"task {row['task']}: finish {row['finish']} is not start {row['start']} + duration {row['duration']}"
        for row in rows
        if row["finish"] != row["start"] + row["duration"]
    ]
    differing = sorted(task for task in given if given[task] != starts[task])
    return Verdict(not broken, starts, max(finishes.values(), default=0), broken, given_broken, differing)


def _structure_problems(schedule: Mapping[str, Any]) -> Iterator[str]:
    """Tasks left over, done twice or done by somebody who cannot."""
    tasks, done = schedule["tasks"], [row["task"] for row in schedule["dispatch"]]
    for task in range(1, len(tasks) + 1):
        if done.count(task) != 1:
            yield f"task {task}: dispatched {done.count(task)} times"
    for row in schedule["dispatch"]:
        if row["agent"] not in tasks[row["task"] - 1]["eligible"]:
            yield f"task {row['task']}: agent {row['agent']} is not eligible"


def _apart(schedule: Mapping[str, Any], a: int, b: int) -> bool:
    """Whether two tasks may overlap in time."""
    if schedule["proximity"] == "none":
        return True
    here, there = (schedule["tasks"][task - 1]["location"] for task in (a, b))
    if schedule["proximity"] == "location":
        return bool(here != there)
    return math.dist(here, there) > schedule["safety_distance"]


def _longest_paths(schedule: Mapping[str, Any]) -> dict[int, int]:
    """Every dispatched task's earliest start, or nothing if the precedences are cyclic."""
    rows = schedule["dispatch"]
    duration = {row["task"]: row["duration"] for row in rows}
    lags: dict[int, dict[int, int]] = {task: {} for task in duration}
    for place, row in enumerate(rows):
        for earlier in rows[:place]:
            if earlier["agent"] == row["agent"] or not _apart(schedule, earlier["task"], row["task"]):
                lags[row["task"]][earlier["task"]] = 0
        for wait in schedule["tasks"][row["task"] - 1]["waits"]:
            if wait["after"] in duration:
                lags[row["task"]][wait["after"]] = max(wait["time"], lags[row["task"]].get(wait["after"], 0))
    starts: dict[int, int] = {}
    released = {row["task"]: row.get("committed", 0) for row in rows}
    try:
        for task in TopologicalSorter({task: list(ahead) for task, ahead in lags.items()}).static_order():
            ends = [starts[other] + duration[other] + lag for other, lag in lags[task].items()]
            starts[task] = max([released[task], *ends])
    except CycleError:
        return {}
    return starts


def _broken(schedule: Mapping[str, Any], starts: Mapping[int, int]) -> Iterator[str]:
    """Constraints that these starts break."""
    rows, tasks = schedule["dispatch"], schedule["tasks"]
    finish = {row["task"]: starts[row["task"]] + row["duration"] for row in rows}
    for place, row in enumerate(rows):
        task = row["task"]
        if starts[task] < row.get("committed", 0):
            yield f"task {task}: starts at {starts[task]} before its agent committed"
        deadline = tasks[task - 1]["deadline"]
        if deadline is not None and finish[task] > deadline:
            yield f"task {task}: finishes at {finish[task]} after its deadline {deadline}"
        for wait in tasks[task - 1]["waits"]:
            other = wait["after"]
            if other in finish and starts[task] < finish[other] + wait["time"]:
                yield f"task {task}: starts at {starts[task]}, less than {wait['time']} after task {other}"
        for earlier in rows[:place]:
            other = earlier["task"]
            if starts[task] < finish[other]:
                if earlier["agent"] == row["agent"]:
                    yield f"tasks {other} and {task}: agent {row['agent']} does both at once or out of order"
                if not _apart(schedule, other, task):
                    yield f"tasks {other} and {task}: too close to overlap, or out of order of dispatch"
    if finish and max(finish.values()) > schedule["longest"]:
        yield f"the round takes {max(finish.values())}, more than {schedule['longest']}, by waiting for nothing"

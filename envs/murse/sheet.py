"""The tasks of a plant as a spreadsheet: a task in every row, a column for every robot and human."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE, MurseInstance, find_cycle
from marl_sched.envs.murse.learning import CURVE
from marl_sched.sheets import Column, Complaints, Row, Setting, Sheet, number, text

_LONGEST = 2**31 - 1
_LAG = re.compile(r"(.+?)\s*\+\s*(\d+)")
ROBOT, HUMAN, SPREAD = "robot *", "human *", "spread *"


def _waits(words: str | None, places: Mapping[str, int]) -> tuple[list[tuple[int, int]], list[str]]:
    """What `T1 & T2+5` says: (place of the task, time) of each, and the words that name no task."""
    found, unknown = [], []
    for one in (part.strip() for part in (words or "").split("&")):
        lag = _LAG.fullmatch(one)
        if one in places:
            found.append((places[one], 0))
        elif lag and lag[1] in places:
            found.append((places[lag[1]], int(lag[2])))
        elif one:
            unknown.append(one)
    return found, unknown


def _check(rows: Sequence[Row], settings: Mapping[str, Any], complaints: Complaints) -> None:
    """Note tasks that nobody can do, waits for tasks that are not there or in a circle, and half of a place."""
    places = {row["task"]: i for i, row in enumerate(rows) if row["task"] is not None}
    waits = []
    for i, row in enumerate(rows):
        if not any(value is not None for value in (*row[ROBOT].values(), *row[HUMAN].values())):
            complaints.add(row.number, "", "a duration of at least one robot or human")
        for name in row[SPREAD]:
            if name not in row[HUMAN]:
                complaints.add(1, f"spread {name}", f"a column human {name} beside it")
                return
        if (row["x"] is None) != (row["y"] is None) or (row["x"] is None) != (rows[0]["x"] is None):
            complaints.add(row.number, "x, y", "both, in every row or in none")
        after, unknown = _waits(row["after"], places)
        for one in unknown:
            complaints.add(row.number, "after", "names of tasks, each with +TIME or not, parted by &", one)
        waits += [(i, j, time) for j, time in after]
    cycle = find_cycle(len(rows), np.array(waits, np.int64).reshape(-1, 3))
    if cycle:
        way = " -> ".join(str(rows[i]["task"]) for i in cycle)
        complaints.add(rows[cycle[0]].number, "after", "tasks that do not wait for one another in a circle", way)


def _build(rows: Sequence[Row], settings: Mapping[str, Any]) -> MurseInstance:
    robots, humans = list(rows[0][ROBOT]), list(rows[0][HUMAN])
    places = {row["task"]: i for i, row in enumerate(rows)}
    curves = np.zeros((len(rows), len(humans), len(CURVE)))
    for i, row in enumerate(rows):
        for h, name in enumerate(humans):
            if row[HUMAN][name] is not None:
                curves[i, h, :2] = row[HUMAN][name], row[SPREAD].get(name) or 0.0
    longest = curves[:, :, 0] + 4 * curves[:, :, 1]
    located = rows[0]["x"] is not None
    durations = [[INELIGIBLE if row[ROBOT][name] is None else row[ROBOT][name] for name in robots] for row in rows]
    return MurseInstance(
        robot_durations=np.array(durations, np.int64).reshape(len(rows), len(robots)),
        curves=curves,
        deadlines=np.array([NO_DEADLINE if row["deadline"] is None else row["deadline"] for row in rows]),
        waits=np.array([(i, j, w) for i, row in enumerate(rows) for j, w in _waits(row["after"], places)[0]], np.int64),
        locations=np.array([[row["x"], row["y"]] if located else [0.0, 0.0] for row in rows]),
        weights=np.array([1.0 if row["weight"] is None else row["weight"] for row in rows]),
        proximity="distance" if located else "none",
        safety_distance=settings["safety"],
        learning="none",
        durations="stochastic" if curves[:, :, 1].any() else "deterministic",
        duration_range=(1, max(1, int(np.ceil(longest.max(initial=1.0))))),
        n_rounds=settings["rounds"],
        task_names=tuple(row["task"] for row in rows),
        agent_names=(*robots, *humans),
    )


TASKS = Sheet(
    row="task",
    key="task",
    columns=(
        Column(name="task", cell=text(), meaning="name of the task"),
        Column(
            name=ROBOT,
            cell=number(0, _LONGEST, unit="time units", whole=True),
            meaning="how long the robot of that name takes, empty: it cannot; a column for each robot",
            optional=True,
        ),
        Column(
            name=HUMAN,
            cell=number(1, _LONGEST, unit="time units", whole=True),
            meaning="how long the human of that name takes on average, empty: cannot; a column for each human",
            optional=True,
        ),
        Column(
            name=SPREAD,
            cell=number(0, _LONGEST, unit="time units"),
            meaning="standard deviation of what the human of that name takes",
            optional=True,
        ),
        Column(
            name="deadline",
            cell=number(0, _LONGEST, unit="time units", whole=True),
            meaning="latest finish",
            optional=True,
        ),
        Column(
            name="after",
            cell=text(),
            meaning="tasks that end before it starts, parted by &; A+5 is five time units after the end of A",
            optional=True,
        ),
        Column(name="x", cell=number(-1e9, 1e9), meaning="where the task is", optional=True),
        Column(name="y", cell=number(-1e9, 1e9), meaning="where the task is", optional=True),
        Column(name="weight", cell=number(0, 1e9), meaning="cost of a time unit until its finish", optional=True),
    ),
    examples=(
        {
            "task": "drill",
            "robot arm": "20",
            "human Ann": "25",
            "spread Ann": "3",
            "deadline": "",
            "after": "",
            "x": "0",
            "y": "0",
        },
        {
            "task": "seal",
            "robot arm": "",
            "human Ann": "18",
            "spread Ann": "2",
            "deadline": "90",
            "after": "drill+5",
            "x": "0",
            "y": "3",
        },
        {
            "task": "inspect",
            "robot arm": "12",
            "human Ann": "15",
            "spread Ann": "",
            "deadline": "120",
            "after": "drill & seal",
            "x": "4",
            "y": "3",
        },
    ),
    settings=(
        Setting(
            name="rounds", cell=number(1, 100_000, whole=True), meaning="how often the tasks are done", default="1"
        ),
        Setting(
            name="safety",
            cell=number(0, 1e9),
            meaning="tasks whose places are at most so far apart must not overlap",
            default="1",
        ),
    ),
    check=_check,
    build=_build,
)

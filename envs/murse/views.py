"""What an agent sees of a MuRSE problem: everything, or its neighbourhood on the map.

An agent stands where its last task was, at the start of a round at the map's origin (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marl_sched.envs.murse.rules import ONLINE, Rules
from marl_sched.envs.murse.state import NOBODY, NOTHING, State
from marl_sched.errors import InvalidOptionError
from marl_sched.kernels import kernel

EVERYWHERE = float("inf")


@dataclass(frozen=True, kw_only=True)
class FullView:
    """Every agent sees every task and every agent with its commitments."""

    kind = "full"
    hides = False

    @property
    def limits(self) -> tuple[float, float]:
        """(sensing, comm) as the kernels take them."""
        return EVERYWHERE, EVERYWHERE


@dataclass(frozen=True, kw_only=True)
class LocalView:
    """An agent sees tasks within distance `sensing` and those one wait away from them, and agents within `comm`.

    Of an agent within `comm` it knows the commitments; of an agent that it cannot hear it knows none, so that it
    may choose a task that is taken. It then idles one time unit and remembers for the round who has the task.
    What a task waits for belongs to the task: one that waits for a task out of sight cannot be chosen.
    Raises InvalidOptionError for a negative option.
    """

    kind = "local"
    hides = True

    sensing: float = 4.0  # map units
    comm: float = 4.0

    def __post_init__(self) -> None:
        """Refuse negative options."""
        for name in ("sensing", "comm"):
            if not getattr(self, name) >= 0:
                raise InvalidOptionError(f"view local: {name}: expected a number >= 0, got {getattr(self, name)}")

    @property
    def limits(self) -> tuple[float, float]:
        """(sensing, comm) as the kernels take them."""
        return self.sensing, self.comm


VIEWS: dict[str, type] = {"full": FullView, "local": LocalView}


class Sight(NamedTuple):
    """What one agent knows at one decision epoch."""

    heard: np.ndarray  # bool (A,), agents within hearing
    seen: np.ndarray  # bool (N,), tasks in sight
    known: np.ndarray  # bool (N,), tasks known to be taken
    start: np.ndarray  # int64 (N,), believed times of the known ones
    finish: np.ndarray


@kernel
def standpoint(state: State, b: int, agent: int) -> tuple[float, float]:
    """Where an agent stands."""
    task = state.agents[b, agent].last_task
    if task == NOTHING:
        return 0.0, 0.0
    return state.tasks[b, task].x, state.tasks[b, task].y


@kernel
def hears(state: State, b: int, viewer: int, comm: float, heard: np.ndarray) -> None:
    """Which agents are within `comm` of the viewer, itself included: writes bool (A,)."""
    x, y = standpoint(state, b, viewer)
    heard[:] = False
    for agent in range(state.rows[b].n_agents):
        there_x, there_y = standpoint(state, b, agent)
        heard[agent] = agent == viewer or np.hypot(there_x - x, there_y - y) <= comm


@kernel
def senses(state: State, b: int, viewer: int, sensing: float, seen: np.ndarray) -> int:
    """Which tasks the viewer sees: writes bool (N,), returns how many."""
    n = state.rows[b].n_tasks
    seen[n:] = False
    if sensing == EVERYWHERE:
        seen[:n] = True
        return n
    x, y = standpoint(state, b, viewer)
    near = np.zeros(n, np.bool_)
    for task in range(n):
        near[task] = np.hypot(state.tasks[b, task].x - x, state.tasks[b, task].y - y) <= sensing
    seen[:n] = False
    count = 0
    for task in range(n):
        seen[task] = near[task]
        for other in range(n):
            linked = state.lags[b, task, other] >= 0 or state.lags[b, other, task] >= 0
            seen[task] = seen[task] or (linked and near[other])
        count += seen[task]
    return count


@kernel
def knows(state: State, b: int, viewer: int, heard: np.ndarray, known: np.ndarray) -> None:
    """Of which tasks the viewer knows that they are taken: writes bool (N,)."""
    for task in range(state.rows[b].n_tasks):
        agent = state.tasks[b, task].agent
        known[task] = agent != NOBODY and (heard[agent] or state.private_memory[b, viewer, task, 1] >= 0)


@kernel
def believes(
    state: State,
    rules: Rules,
    b: int,
    viewer: int,
    heard: np.ndarray,
    known: np.ndarray,
    start: np.ndarray,
    finish: np.ndarray,
) -> None:
    """When the tasks of `known`, bool (N,), start and finish as far as one can tell now: writes int64 (N,).

    A plan's times are common knowledge. In `online` mode a finished task's times are the truth; of a running one
    the start, to which its planned duration is added (it takes at least until the next unit); one that has not
    started follows from the beliefs about what it waits for, in order of commitment. What was
    learned from a conflict stays as it was learned.
    """
    row, tasks = state.rows[b], state.tasks[b]
    for k in range(row.dispatched):
        task = state.order[b, k]
        if not known[task]:
            continue
        job = tasks[task]
        if not heard[job.agent]:
            start[task], finish[task] = state.private_memory[b, viewer, task]
            continue
        start[task], finish[task] = job.start, job.finish
        if rules.mode != ONLINE or job.finish <= row.clock:
            continue
        if job.start > row.clock:
            begin = job.committed
            for m in range(k):
                other = state.order[b, m]
                if known[other]:
                    if state.lags[b, task, other] >= 0:
                        begin = max(begin, finish[other] + state.lags[b, task, other])
                    elif state.near[b, task, other]:
                        begin = max(begin, finish[other])
            start[task] = begin
        finish[task] = max(start[task] + state.pairs[b, task, job.agent].planned, row.clock + 1)


@kernel
def new_sight(state: State) -> Sight:
    """Room for what an agent knows, to be filled by `survey`."""
    n, m = state.tasks.shape[1], state.agents.shape[1]
    times = np.zeros((2, n), np.int64)
    return Sight(np.zeros(m, np.bool_), np.zeros(n, np.bool_), np.zeros(n, np.bool_), times[0], times[1])


@kernel
def survey(state: State, rules: Rules, b: int, viewer: int, sensing: float, comm: float, sight: Sight) -> None:
    """Fill in everything that the viewer knows under (sensing, comm)."""
    hears(state, b, viewer, comm, sight.heard)
    senses(state, b, viewer, sensing, sight.seen)
    knows(state, b, viewer, sight.heard, sight.known)
    believes(state, rules, b, viewer, sight.heard, sight.known, sight.start, sight.finish)

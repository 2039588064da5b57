"""List scheduling: whoever is free earliest takes the startable task of the highest priority, else waits.

The compiled form of the priority rules for a whole round, on the same turns as the simulator: it gives planners
their first schedule and completes those that are part of the way.
"""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.problem import Begun, Plan, Round
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.rules import FIRST, LEAST_LEFT, MEAN_ALL, PICKING
from marl_sched.envs.murse.state import NEVER, NOBODY, NOT_WAITING
from marl_sched.envs.murse.timetable import earliest_start, waits_heeded
from marl_sched.errors import require
from marl_sched.kernels import kernel

NO_DEADLINE_PRIORITY = 1e9
"""Tasks without a deadline come after all that have one."""


@kernel
def preference(durations: np.ndarray, done: np.ndarray, picking: int, agent: int) -> float:
    """What the picking strategy minimises (section 4.2.2), on int64 (N, A) durations and bool (N,) `done`."""
    if picking == FIRST:
        return 0.0
    count, total, least = 0, 0.0, np.inf
    for task in range(len(durations)):
        duration = durations[task, agent]
        if duration >= 0 and (picking == MEAN_ALL or not done[task]):
            count += 1
            total += duration
            least = min(least, duration)
    return least if picking == LEAST_LEFT or count == 0 else total / count


@kernel
def next_event_time(clock: int, order: np.ndarray, count: int, lags: np.ndarray, finish: np.ndarray) -> int:
    """When the next dispatched task ends or wait elapses after `clock`; NEVER if none does."""
    wakes = NEVER
    for k in range(count):
        end = finish[order[k]]
        if end > clock:
            wakes = min(wakes, end)
        for task in range(len(lags)):
            lag = lags[task, order[k]]
            if lag > 0 and end + lag > clock:
                wakes = min(wakes, end + lag)
    return wakes


@kernel
def best_startable(
    priority: np.ndarray,
    agent: int,
    clock: int,
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    done: np.ndarray,
    order: np.ndarray,
    count: int,
    finish: np.ndarray,
) -> int:
    """The task of least priority value, float64 (N, A), that `agent` can start at `clock`; -1 if there is none."""
    best = -1
    for task in range(len(durations)):
        if done[task] or durations[task, agent] < 0:
            continue
        if best >= 0 and priority[task, agent] >= priority[best, agent]:
            continue
        if not waits_heeded(task, len(durations), order, count, lags):
            continue
        if earliest_start(task, clock, order, count, lags, near, finish) == clock:
            best = task
    return best


@kernel
def dispatch_all(
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    priority: np.ndarray,
    picking: int,
    free_at: np.ndarray,
    order: np.ndarray,
    count: int,
    doers: np.ndarray,
    finish: np.ndarray,
) -> int:
    """Append to `order`, int64 (N,), of which the first `count` are dispatched; returns how many are then.

    doers and finish int64 (N,) hold the agents and finishes of dispatched tasks and are written, free_at int64
    (A,) likewise.
    """
    n = len(durations)
    done = np.zeros(n, np.bool_)
    done[order[:count]] = True
    since = np.full(len(free_at), NOT_WAITING, np.int64)
    while count < n:
        clock = free_at.min()
        if clock >= NEVER:
            break
        agent, least = NOBODY, np.inf
        for a in range(len(free_at)):
            if free_at[a] == clock:
                key = preference(durations, done, picking, a)
                if agent == NOBODY or key < least:
                    agent, least = a, key
        since[agent] = NOT_WAITING
        task = best_startable(priority, agent, clock, durations, lags, near, done, order, count, finish)
        if task < 0:
            free_at[agent], since[agent] = next_event_time(clock, order, count, lags, finish), clock
            continue
        order[count], doers[task], done[task] = task, agent, True
        count += 1
        finish[task] = free_at[agent] = clock + durations[task, agent]
        for a in range(len(free_at)):
            if since[a] != NOT_WAITING:
                free_at[a] = min(free_at[a], max(clock, since[a] + 1))
    return count


def list_schedule(problem: Round, priority: np.ndarray, picking: str = "first") -> Plan:
    """Complete a round by a priority, float64 (N,) or (N, A), smaller first, ties by index.

    Tasks that are committed to keep their times. The plan is not feasible if nobody can ever start what is left.
    Raises UnknownNameError for an unknown picking strategy.
    """
    n, m = problem.n_tasks, problem.n_agents
    code = PICKING.index(require("picking strategy", picking, PICKING))
    values = np.broadcast_to(priority[:, None] if priority.ndim == 1 else priority, (n, m)).astype(np.float64)
    begun = Begun.of(problem)
    count = dispatch_all(
        problem.durations, problem.lags, problem.near, values, code, begun.free_at, begun.order, begun.count,
        begun.doers, begun.finish,
    )  # fmt: skip
    return begun.plan(problem, count)


def edf_priority(deadlines: np.ndarray) -> np.ndarray:
    """Earliest deadline first, float64 (N,)."""
    return np.where(deadlines == NO_DEADLINE, NO_DEADLINE_PRIORITY, deadlines).astype(np.float64)


def edf_schedule(problem: Round, picking: str = "first") -> Plan:
    """The schedule of the rule `edf` for a whole round."""
    return list_schedule(problem, edf_priority(problem.deadlines), picking)

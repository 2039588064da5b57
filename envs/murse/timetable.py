"""From a dispatch order to times: when each task starts at the earliest, and whether that is possible.

A schedule is a dispatch order of (task, agent) pairs. Each task starts at the earliest time that respects its
agent's previous task, the waits, and, towards tasks dispatched earlier that are near, their finish. That is the
earliest solution of a simple temporal network whose bounds all point forward in time, so a longest path over
the dispatched tasks finds it; the network is inconsistent when tasks must precede each other.
"""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.kernels import kernel


@kernel
def earliest_start(
    task: int, ready: int, order: np.ndarray, count: int, lags: np.ndarray, near: np.ndarray, finish: np.ndarray
) -> int:
    """When `task` can start behind the first `count` tasks of `order`, int64 (N,), with its agent ready at `ready`.

    lags int64 (N, N) and near bool (N, N) as in MurseInstance, finish int64 (N,) of the tasks before.
    """
    start = ready
    for k in range(count):
        other = order[k]
        if lags[task, other] >= 0:
            start = max(start, finish[other] + lags[task, other])
        elif near[task, other]:
            start = max(start, finish[other])
    return start


@kernel
def waits_heeded(task: int, n_tasks: int, order: np.ndarray, count: int, lags: np.ndarray) -> bool:
    """Whether all tasks for which `task` waits stand among the first `count` of `order`."""
    ahead = 0
    for other in range(n_tasks):
        ahead += lags[task, other] >= 0
    for k in range(count):
        ahead -= lags[task, order[k]] >= 0
    return ahead == 0


@kernel
def time_order(
    order: np.ndarray,
    agents: np.ndarray,
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    start: np.ndarray,
    finish: np.ndarray,
) -> bool:
    """Earliest times of a whole or partial schedule; False if its network is inconsistent.

    order and agents int64 (K,) are the pairs in order of dispatch, each task once; durations int64 (N, A).
    Writes start and finish int64 (N,) of the tasks in `order`. Waits for tasks that are not in `order` do not
    count, and a task may be dispatched before one that it waits for, as long as they can be timed.
    """
    count = len(order)
    for k in range(count):
        start[order[k]] = 0
        finish[order[k]] = durations[order[k], agents[k]]
    for _ in range(count + 1):
        moved = False
        for k in range(count):
            task = order[k]
            begin = start[task]
            for m in range(count):
                other = order[m]
                if lags[task, other] >= 0:
                    begin = max(begin, finish[other] + lags[task, other])
                if m < k and (agents[m] == agents[k] or near[task, other]):
                    begin = max(begin, finish[other])
            if begin > start[task]:
                start[task] = begin
                finish[task] = begin + durations[task, agents[k]]
                moved = True
        if not moved:
            return True
    return False


@kernel
def deadlines_hold(order: np.ndarray, finish: np.ndarray, deadlines: np.ndarray) -> bool:
    """Whether every task of `order`, int64 (K,), ends by its deadline, int64 (N,)."""
    for k in range(len(order)):
        deadline = deadlines[order[k]]
        if deadline != NO_DEADLINE and finish[order[k]] > deadline:
            return False
    return True


@kernel
def time_batch(
    orders: np.ndarray,
    agents: np.ndarray,
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    deadlines: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time many whole schedules of one problem: (starts, finishes, makespans, feasible).

    orders and agents int64 (B, N); durations int64 (N, A); lags, near and deadlines as in MurseInstance.
    Returns int64 (B, N) twice, int64 (B,) and bool (B,): consistent, every deadline held and every pair eligible.
    """
    batch, n = orders.shape
    starts, finishes = np.zeros((batch, n), np.int64), np.zeros((batch, n), np.int64)
    makespans, feasible = np.zeros(batch, np.int64), np.zeros(batch, np.bool_)
    for b in range(batch):
        good = time_order(orders[b], agents[b], durations, lags, near, starts[b], finishes[b])
        for k in range(n):
            good = good and durations[orders[b, k], agents[b, k]] >= 0
        feasible[b] = good and deadlines_hold(orders[b], finishes[b], deadlines)
        makespans[b] = finishes[b].max()
    return starts, finishes, makespans, feasible


@kernel
def worst_case(durations: np.ndarray) -> int:
    """The largest sum of one agent's durations over all tasks, int64 (N, A) with INELIGIBLE pairs.

    For a task that the agent cannot do, the longest duration of those who can stands in: somebody has to do it.
    """
    worst = 0
    for agent in range(durations.shape[1]):
        total = 0
        for task in range(durations.shape[0]):
            own = durations[task, agent]
            total += own if own >= 0 else durations[task].max()
        worst = max(worst, total)
    return worst


@kernel
def longest_round(durations: np.ndarray, lags: np.ndarray) -> int:
    """The sum of every task's longest duration and of all waits: no schedule without idleness takes longer."""
    total = 0
    for task in range(durations.shape[0]):
        total += durations[task].max()
        for other in range(durations.shape[0]):
            total += max(lags[task, other], 0)
    return total

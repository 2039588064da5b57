"""Latest starts that count agents and places: a schedule of what is open, generated from the end backwards.

The latest starts of `latest_start` assume that every task behind another starts as soon as it may. Where several
urgent tasks need the same place or the same few agents, some of them have to begin earlier than that. Here time is
turned round and a list schedule is generated from the latest finishes, the latest one first; a task's start in it is
its key.
"""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse import latest_start as lst
from marl_sched.agents.murse.problem import Round
from marl_sched.kernels import kernel

_FAR = 1e18
_LATE = 2.0  # by when tasks that no deadline presses have to end, in the larger of common horizon and latest deadline


def latest_finishes(problem: Round) -> tuple[np.ndarray, np.ndarray]:
    """The latest finish of each task by deadlines and waits alone, float64 (N,), and whether a deadline presses it.

    Tasks with no deadline at or behind them have to end so late that nobody has to hurry for them.
    """
    late = _LATE * max(lst.common_horizon(problem.durations), float(problem.deadlines.max()))
    none = np.full(problem.n_tasks, -1, np.int64)
    starts = lst.latest_starts(problem.durations, problem.lags, problem.deadlines, late)
    unpressed = lst.latest_starts(problem.durations, problem.lags, none, late)
    return starts + lst.shortest_durations(problem.durations), starts < unpressed


def backward_keys(problem: Round) -> np.ndarray:
    """`backward_starts` of what is open in a round, float64 (N,)."""
    found: np.ndarray = backward_starts(
        problem.durations,
        lst.successors(problem.lags),
        problem.lags,
        problem.near,
        problem.fixed < 0,
        latest_finishes(problem)[0],
    )
    return found


@kernel
def backward_starts(
    durations: np.ndarray,
    waiting: tuple[np.ndarray, np.ndarray, np.ndarray],
    lags: np.ndarray,
    near: np.ndarray,
    still_open: np.ndarray,
    ends: np.ndarray,
) -> np.ndarray:
    """The starts of open tasks in a schedule that is generated backwards, float64 (N,); 0 for the others.

    durations int64 (N, A), INELIGIBLE where a pair is; `waiting` as `latest_start.successors` gives it, of lags int64
    (N, N); near bool (N, N); still_open bool (N,); ends float64 (N,), when each task has to have finished, whatever
    else there is. Of the tasks behind which everything is placed the one of the latest finish is placed next, on the
    agent with whom it starts latest. Ties go to the lower index. Starts may be negative.
    """
    n, m = durations.shape
    first, tasks, _ = waiting
    behind, latest = np.zeros(n, np.int64), ends.copy()
    for task in range(n):
        for k in range(first[task], first[task + 1]):
            behind[task] += still_open[tasks[k]]
    start, until, left = np.zeros(n), np.full(m, _FAR), still_open.copy()
    for _ in range(n):
        chosen = -1
        for task in range(n):
            if left[task] and behind[task] == 0 and (chosen < 0 or latest[task] > latest[chosen]):
                chosen = task
        if chosen < 0:
            break
        best, doer = -_FAR, -1
        for agent in range(m):
            if durations[chosen, agent] >= 0:
                begins = min(latest[chosen], until[agent]) - durations[chosen, agent]
                if begins > best:
                    best, doer = begins, agent
        start[chosen], until[doer], left[chosen] = best, best, False
        for other in range(n):
            if left[other]:
                if near[chosen, other]:
                    latest[other] = min(latest[other], best)
                if lags[chosen, other] >= 0:
                    latest[other] = min(latest[other], best - lags[chosen, other])
                    behind[other] -= 1
    return start

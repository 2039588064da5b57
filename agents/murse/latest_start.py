"""Least latest start first (LST): a priority rule, its schedule generation and a hill climb on its keys, compiled.

The key of a task is the latest start at which every deadline behind it can still be held: latest finishes are
propagated backwards through the waits, everybody taking their shortest; a task without a deadline has to end by a
common horizon, HORIZON_LOADS x the mean load. Schedules are generated as by Giffler and Thompson (1960): let F be
the least possible finish over eligible tasks and agents; of the tasks that can start before F on the agent that
would finish them earliest, the one of the least key is dispatched to that agent.

All functions take plain arrays, so that simulators, searches and learned policies can call them:

    keys = latest_starts(durations, lags, deadlines, common_horizon(durations))
    order, agents, starts, finishes = generate(durations, lags, near, keys)

durations int64 (N, A), INELIGIBLE where a pair is; lags int64 (N, N), [i, j] the time that i waits after j finishes, -1
where it need not; near bool (N, N), pairs that must not overlap; deadlines int64 (N,), NO_DEADLINE for none.
"""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.kernels import kernel
from marl_sched.noise import time_key, uniform

HORIZON_LOADS = 1.3
"""The horizon of tasks without a deadline, in mean loads of an agent."""

MOVED = 6.0
"""Keys that an evaluation of the hill climb moves, on average."""
REACH = 0.35
"""How far a key moves at most, in common horizons."""
MAKESPAN, WEIGHTED = 0, 1
_UNREACHED = 1 << 60
_STREAM = 0  # of the search's draws


@kernel
def shortest_durations(durations: np.ndarray) -> np.ndarray:
    """The least duration of each task over its eligible agents, int64 (N,)."""
    shortest = np.full(len(durations), _UNREACHED, np.int64)
    for task in range(len(durations)):
        for agent in range(durations.shape[1]):
            if durations[task, agent] >= 0:
                shortest[task] = min(shortest[task], durations[task, agent])
    return shortest


@kernel
def common_horizon(durations: np.ndarray) -> float:
    """HORIZON_LOADS x the mean load: every task at its mean duration, shared evenly among the agents."""
    total = 0.0
    for task in range(len(durations)):
        own, able = 0, 0
        for agent in range(durations.shape[1]):
            if durations[task, agent] >= 0:
                own += durations[task, agent]
                able += 1
        total += own / max(able, 1)
    return HORIZON_LOADS * total / durations.shape[1]


@kernel
def latest_starts(durations: np.ndarray, lags: np.ndarray, deadlines: np.ndarray, horizon: float) -> np.ndarray:
    """Latest start of each task, float64 (N,); negative where a deadline cannot be held.

    Tasks without a deadline, and none behind them, have to end by `horizon`. Tasks on a cycle of waits keep what
    their own deadline or the horizon says.
    """
    n = len(durations)
    shortest, finish, behind = shortest_durations(durations), np.empty(n), np.zeros(n, np.int64)
    for task in range(n):
        finish[task] = horizon if deadlines[task] == NO_DEADLINE else deadlines[task]
        for other in range(n):
            behind[other] += lags[task, other] >= 0
    ready, count = np.empty(n, np.int64), 0
    for task in range(n):
        if behind[task] == 0:
            ready[count] = task
            count += 1
    at = 0
    while at < count:
        task = ready[at]
        at += 1
        for other in range(n):
            if lags[task, other] >= 0:
                finish[other] = min(finish[other], finish[task] - shortest[task] - lags[task, other])
                behind[other] -= 1
                if behind[other] == 0:
                    ready[count] = other
                    count += 1
    return finish - shortest


@kernel
def successors(lags: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Who waits for each task, as lists: (first int64 (N + 1,), tasks int64 (W,), lags int64 (W,)).

    The tasks that wait for j are `tasks[first[j] : first[j + 1]]`.
    """
    n = len(lags)
    first = np.zeros(n + 1, np.int64)
    for task in range(n):
        for other in range(n):
            if lags[task, other] >= 0:
                first[other + 1] += 1
    for task in range(n):
        first[task + 1] += first[task]
    tasks, times, filled = np.empty(first[n], np.int64), np.empty(first[n], np.int64), first[:n].copy()
    for task in range(n):
        for other in range(n):
            if lags[task, other] >= 0:
                tasks[filled[other]], times[filled[other]] = task, lags[task, other]
                filled[other] += 1
    return first, tasks, times


@kernel
def _earliest_on(durations: np.ndarray, task: int, release: int, ready: np.ndarray) -> tuple[int, int, int]:
    """The agent that finishes a task earliest, ties to the lower index, with its start and finish."""
    best, start, finish = -1, _UNREACHED, _UNREACHED
    for agent in range(len(ready)):
        lasts = durations[task, agent]
        if lasts >= 0:
            begin = max(ready[agent], release)
            if begin + lasts < finish:
                best, start, finish = agent, begin, begin + lasts
    return best, start, finish


@kernel
def complete(
    durations: np.ndarray,
    waiting: tuple[np.ndarray, np.ndarray, np.ndarray],
    near: np.ndarray,
    keys: np.ndarray,
    ready: np.ndarray,
    order: np.ndarray,
    count: int,
    doers: np.ndarray,
    start: np.ndarray,
    finish: np.ndarray,
) -> int:
    """Generate the rest of a schedule of which the first `count` of `order`, int64 (N,), are dispatched.

    `waiting` is what `successors` returns; ready int64 (A,) is when agents are free at the earliest, and is written;
    doers, start and finish int64 (N,) hold dispatched tasks' agents and times, and are written. Ties of keys,
    float64 (N,), go to the earlier finish, then to the lower index. Returns how many tasks are dispatched then: fewer
    than N if the rest waits in a circle.
    """
    n = len(durations)
    first, tasks, lags = waiting
    ahead, release = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for k in range(first[n]):
        ahead[tasks[k]] += 1
    done, fresh = np.zeros(n, np.bool_), np.ones(n, np.bool_)
    best, begin, end = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(count):
        done[order[k]] = True
        release_others(order[k], finish[order[k]], first, tasks, lags, near, ahead, release, fresh)
    while count < n:
        least = _UNREACHED
        for task in range(n):
            if done[task] or ahead[task] > 0:
                continue
            if fresh[task]:
                best[task], begin[task], end[task] = _earliest_on(durations, task, release[task], ready)
                fresh[task] = False
            least = min(least, end[task])
        chosen = -1
        for task in range(n):
            if done[task] or ahead[task] > 0 or (begin[task] >= least and end[task] > least):
                continue
            if chosen < 0 or keys[task] < keys[chosen] or (keys[task] == keys[chosen] and end[task] < end[chosen]):
                chosen = task
        if chosen < 0:
            break
        agent = best[chosen]
        order[count], doers[chosen], start[chosen], finish[chosen] = chosen, agent, begin[chosen], end[chosen]
        done[chosen] = True
        count += 1
        ready[agent] = end[chosen]
        for task in range(n):
            if best[task] == agent:
                fresh[task] = True
        release_others(chosen, end[chosen], first, tasks, lags, near, ahead, release, fresh)
    return count


@kernel
def release_others(
    task: int,
    end: int,
    first: np.ndarray,
    tasks: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    ahead: np.ndarray,
    release: np.ndarray,
    fresh: np.ndarray,
) -> None:
    """Note for all others that `task` has been dispatched and ends at `end`.

    first, tasks and lags are what `successors` returns; ahead int64 (N,), the tasks still to be dispatched before each,
    and release int64 (N,), its least start, are written; `fresh`, bool (N,), marks those for which something changed.
    """
    for k in range(first[task], first[task + 1]):
        other = tasks[k]
        ahead[other] -= 1
        release[other] = max(release[other], end + lags[k])
        fresh[other] = True
    for other in range(len(near)):
        if near[task, other] and release[other] < end:
            release[other] = end
            fresh[other] = True


@kernel
def generate(
    durations: np.ndarray, lags: np.ndarray, near: np.ndarray, keys: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The schedule of a whole round by keys, float64 (N,), least first: (order, agents, starts, finishes).

    All int64 (N,); order and agents are the pairs in order of dispatch, shorter if tasks wait in a circle.
    """
    n, ready = len(durations), np.zeros(durations.shape[1], np.int64)
    order, doers = np.zeros(n, np.int64), np.full(n, -1, np.int64)
    start, finish = np.zeros(n, np.int64), np.zeros(n, np.int64)
    count = complete(durations, successors(lags), near, keys, ready, order, 0, doers, start, finish)
    return order[:count], doers[order[:count]], start, finish


@kernel
def least_latest_start(
    durations: np.ndarray, lags: np.ndarray, near: np.ndarray, deadlines: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The rule LST for a whole round in one pass: (order, agents, starts, finishes, keys); see `generate`."""
    keys = latest_starts(durations, lags, deadlines, common_horizon(durations))
    order, agents, start, finish = generate(durations, lags, near, keys)
    return order, agents, start, finish, keys


@kernel
def cost(finish: np.ndarray, deadlines: np.ndarray, weights: np.ndarray, objective: int) -> tuple[int, float]:
    """What the search minimises, in this order: the sum of lateness, then MAKESPAN or WEIGHTED completion time.

    finish and deadlines int64 (N,), weights float64 (N,).
    """
    late, makespan, weighted = 0, 0, 0.0
    for task in range(len(finish)):
        if deadlines[task] != NO_DEADLINE:
            late += max(finish[task] - deadlines[task], 0)
        makespan = max(makespan, finish[task])
        weighted += weights[task] * finish[task]
    return late, weighted if objective == WEIGHTED else float(makespan)


@kernel
def climb(
    durations: np.ndarray,
    waiting: tuple[np.ndarray, np.ndarray, np.ndarray],
    near: np.ndarray,
    deadlines: np.ndarray,
    weights: np.ndarray,
    objective: int,
    free: np.ndarray,
    order: np.ndarray,
    count: int,
    doers: np.ndarray,
    start: np.ndarray,
    finish: np.ndarray,
    keys: np.ndarray,
    best: tuple[int, float],
    key: np.uint64,
    first: int,
    last: int,
) -> tuple[int, float]:
    """Evaluations `first` to `last` - 1 of a hill climb on keys, float64 (N,), which are written; the new best cost.

    In each evaluation about MOVED keys move by up to REACH x the common horizon either way; the schedule that they
    generate behind the first `count` tasks replaces the best one if it costs no more. The draws are those of the
    64-bit `key`, so that a search that is continued equals one that was not interrupted. free int64 (A,) is when
    agents are free at the earliest; the other arrays are those of `complete`, which it overwrites.
    """
    n = len(durations)
    share, reach = MOVED / n, REACH * common_horizon(durations)
    trial, ready = np.empty(n), np.empty_like(free)
    for evaluation in range(first, last):
        drawn = time_key(key, evaluation)
        for task in range(n):
            trial[task] = keys[task]
            if uniform(drawn, _STREAM, task, 0) < share:
                trial[task] += reach * (2.0 * uniform(drawn, _STREAM, task, 1) - 1.0)
        ready[:] = free
        complete(durations, waiting, near, trial, ready, order, count, doers, start, finish)
        found = cost(finish, deadlines, weights, objective)
        if found <= best:
            best = found
            keys[:] = trial
    return best

"""The dispatching rules of the scheduling literature, for job shops, flexible job shops and MuRSE alike.

Whoever is free takes, of the tasks that it can start at once, the one that the rule ranks first; it waits when there
is none. p is the agent's duration, d the latest finish that the deadlines behind a task leave it (a common horizon
for those without any), w its weight, t the time, and the work remaining is that of the task and of all that have to
wait for it, directly or not, at mean durations.

| Rule | First comes the task of the |
|---|---|
| `spt`, `lpt` | shortest, longest p |
| `wspt` | greatest w / p |
| `mwkr`, `mopnr` | most work remaining, most operations remaining |
| `fifo` | earliest time from which it could be started |
| `edd` | earliest d |
| `slack-per-operation` | least (d - t - work remaining) / operations remaining |
| `atc` | greatest apparent tardiness cost, w / p exp(-max(d - p - t, 0) / (K x mean duration)) |

See Panwalkar and Iskander (1977) and, for `atc`, Vepsalainen and Morton (1987).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numba import njit

from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.latest_start import common_horizon, latest_starts, shortest_durations, successors
from marl_sched.agents.murse.problem import Plan, Round
from marl_sched.agents.murse.snapshot import as_expected, estimated_round, remaining_round
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.timetable import deadlines_hold
from marl_sched.errors import require

DISPATCHING_RULES = ("spt", "lpt", "wspt", "mwkr", "mopnr", "fifo", "edd", "slack-per-operation", "atc")
LOOK_AHEAD = 2.0
"""K of `atc`."""
_SPT, _LPT, _WSPT, _MWKR, _MOPNR, _FIFO, _EDD, _SLACK, _ATC = range(len(DISPATCHING_RULES))
_LEAST = 1e-9  # stands for a duration of 0 where one divides by it
_NEVER = 1 << 60


@njit(cache=True)
def remaining(
    means: np.ndarray, first: np.ndarray, tasks: np.ndarray, lags: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Work, float64 (N,), and operations, int64 (N,), of each task and of all that wait for it, each counted once.

    means float64 (N,) are mean durations; the others are what `successors` returns.
    """
    n = len(means)
    work, operations = np.empty(n), np.zeros(n, np.int64)
    seen, stack = np.full(n, -1, np.int64), np.empty(n, np.int64)
    for task in range(n):
        total, height = 0.0, 1
        stack[0], seen[task] = task, task
        while height > 0:
            height -= 1
            at = stack[height]
            total += means[at]
            operations[task] += 1
            for k in range(first[at], first[at + 1]):
                if seen[tasks[k]] != task:
                    seen[tasks[k]] = task
                    stack[height] = tasks[k]
                    height += 1
        work[task] = total
    return work, operations


@njit(cache=True)
def priority(
    rule: int, p: float, due: float, weight: float, released: int, work: float, operations: int, clock: int, mean: float
) -> float:
    """What the rule minimises for a task and an agent, see the module's table; `mean` is the mean duration."""
    if rule == _SPT:
        return p
    if rule == _LPT:
        return -p
    if rule == _WSPT:
        return -weight / max(p, _LEAST)
    if rule == _MWKR:
        return -work
    if rule == _MOPNR:
        return -float(operations)
    if rule == _FIFO:
        return float(released)
    if rule == _EDD:
        return due
    if rule == _SLACK:
        return (due - clock - work) / operations
    return -weight / max(p, _LEAST) * np.exp(-max(due - p - clock, 0.0) / (LOOK_AHEAD * mean))


@njit(cache=True)
def dispatch_rule(
    rule: int,
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    deadlines: np.ndarray,
    weights: np.ndarray,
    free_at: np.ndarray,
    order: np.ndarray,
    count: int,
    doers: np.ndarray,
    finish: np.ndarray,
) -> int:
    """Append to `order`, int64 (N,), of which the first `count` are dispatched, by a rule of DISPATCHING_RULES.

    The arrays are those of a Round; doers and finish int64 (N,) hold agents and finishes of dispatched tasks and are
    written, free_at int64 (A,) likewise. Free agents choose in the order of their index; ties go to the lower task.
    Returns how many are dispatched then.
    """
    n, m = durations.shape
    first, waiting, times = successors(lags)
    means, mean = _mean_durations(durations)
    work, operations = remaining(means, first, waiting, times)
    due = latest_starts(durations, lags, deadlines, common_horizon(durations)) + shortest_durations(durations)
    ahead, release, done = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    for k in range(first[n]):
        ahead[waiting[k]] += 1
    for k in range(count):
        done[order[k]] = True
        _release(order[k], finish[order[k]], first, waiting, times, near, ahead, release)
    open_, n_open = np.empty(n, np.int64), 0
    for task in range(n):
        if not done[task] and ahead[task] == 0:
            open_[n_open] = task
            n_open += 1
    clock = free_at.min()
    while count < n:
        agent = -1
        while agent < m - 1:
            agent += 1
            if free_at[agent] > clock:
                continue
            best, least = -1, np.inf
            for k in range(n_open):
                task = open_[k]
                p = durations[task, agent]
                if p < 0 or release[task] > clock:
                    continue
                key = priority(
                    rule, p, due[task], weights[task], release[task], work[task], operations[task], clock, mean
                )
                if best < 0 or key < least or (key == least and task < open_[best]):
                    best, least = k, key
            if best < 0:
                continue
            task = open_[best]
            n_open -= 1
            open_[best] = open_[n_open]
            order[count], doers[task], done[task] = task, agent, True
            count += 1
            finish[task] = free_at[agent] = clock + durations[task, agent]
            _release(task, finish[task], first, waiting, times, near, ahead, release)
            for k in range(first[task], first[task + 1]):
                if ahead[waiting[k]] == 0:
                    open_[n_open] = waiting[k]
                    n_open += 1
            if free_at[agent] == clock:  # it took no time: everybody may look again
                agent = -1
        clock = _next_time(clock, free_at, open_, n_open, release)
        if clock == _NEVER:
            break
    return count


@njit(cache=True)
def _mean_durations(durations: np.ndarray) -> tuple[np.ndarray, float]:
    """The mean over eligible agents, float64 (N,), and the mean of those."""
    means = np.zeros(len(durations))
    for task in range(len(durations)):
        able = 0
        for agent in range(durations.shape[1]):
            if durations[task, agent] >= 0:
                means[task] += durations[task, agent]
                able += 1
        means[task] /= max(able, 1)
    return means, max(means.mean(), _LEAST)


@njit(cache=True)
def _release(
    task: int,
    end: int,
    first: np.ndarray,
    tasks: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    ahead: np.ndarray,
    release: np.ndarray,
) -> None:
    """Note for all others that `task` has been dispatched and ends at `end`."""
    for k in range(first[task], first[task + 1]):
        ahead[tasks[k]] -= 1
        release[tasks[k]] = max(release[tasks[k]], end + lags[k])
    for other in range(len(near)):
        if near[task, other]:
            release[other] = max(release[other], end)


@njit(cache=True)
def _next_time(clock: int, free_at: np.ndarray, open_: np.ndarray, n_open: int, release: np.ndarray) -> int:
    """When, after `clock`, the next agent is free or the next open task can start; _NEVER if neither happens."""
    after = _NEVER
    for agent in range(len(free_at)):
        if free_at[agent] > clock:
            after = min(after, free_at[agent])
    for k in range(n_open):
        if release[open_[k]] > clock:
            after = min(after, release[open_[k]])
    return after


def dispatched(problem: Round, rule: str) -> Plan:
    """The schedule of a rule of DISPATCHING_RULES behind what is committed to; UnknownNameError for another name."""
    code = DISPATCHING_RULES.index(require("dispatching rule", rule, DISPATCHING_RULES))
    n = problem.n_tasks
    committed = np.flatnonzero(problem.fixed >= 0)
    committed = committed[np.argsort(problem.fixed[committed], kind="stable")]
    order, doers, finish = np.zeros(n, np.int64), problem.agents.copy(), np.zeros(n, np.int64)
    order[: len(committed)] = committed
    finish[committed] = problem.fixed[committed] + problem.durations[committed, doers[committed]]
    count = dispatch_rule(
        code, problem.durations, problem.lags, problem.near, problem.deadlines, problem.weights, problem.ready.copy(),
        order, len(committed), doers, finish,
    )  # fmt: skip
    tasks, starts = order[:count], np.zeros(n, np.int64)
    starts[tasks] = finish[tasks] - problem.durations[tasks, doers[tasks]]
    return Plan(
        tasks=tasks,
        agents=doers[tasks],
        starts=starts,
        finishes=finish,
        makespan=int(finish.max()),
        feasible=count == n and bool(deadlines_hold(tasks, finish, problem.deadlines)),
    )


class DispatchingRule(PlanningScheduler):
    """Plays a rule of DISPATCHING_RULES; in `online` mode anew whenever a task did not end when it was expected to."""

    def __init__(self, rule: str) -> None:
        super().__init__()
        self.name = require("dispatching rule", rule, DISPATCHING_RULES)

    def plan(self, simulator: MurseSimulator, row: int) -> Plan:
        """The rule's schedule of the whole round on estimated durations."""
        return dispatched(estimated_round(simulator, row), self.name)

    def revise(self, simulator: MurseSimulator, row: int, plan: Plan) -> Plan:
        """The rule's schedule of what is left, where something went otherwise."""
        if simulator.mode == "plan":
            return plan
        problem = remaining_round(simulator, row)
        return plan if as_expected(problem, plan) else dispatched(problem, self.name)


def factories() -> dict[str, Callable[[], DispatchingRule]]:
    """The rules as schedulers: name -> what makes one."""
    return {rule: partial(DispatchingRule, rule) for rule in DISPATCHING_RULES}

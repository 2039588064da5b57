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
from typing import NamedTuple

import numpy as np

from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.latest_start import (
    common_horizon,
    latest_starts,
    release_others,
    shortest_durations,
    successors,
)
from marl_sched.agents.murse.problem import Begun, Plan, Round
from marl_sched.agents.murse.snapshot import as_expected, estimated_round, remaining_round
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import require
from marl_sched.kernels import kernel

DISPATCHING_RULES = ("spt", "lpt", "wspt", "mwkr", "mopnr", "fifo", "edd", "slack-per-operation", "atc")
PRIORITY_RULES = (*DISPATCHING_RULES, "edf", "hctf")
"""With the two rules of the dissertation, which rank by a task's own deadline and by its weight alone."""
LOOK_AHEAD = 2.0
"""K of `atc`."""
_SPT, _LPT, _WSPT, _MWKR, _MOPNR, _FIFO, _EDD, _SLACK, _ATC, _EDF, _HCTF = range(len(PRIORITY_RULES))
_LEAST = 1e-9  # stands for a duration of 0 where one divides by it
_NEVER = 1 << 60


@kernel
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


class Urgency(NamedTuple):
    """What the rules rank by.

    Attributes:
        rule: the number of a rule in PRIORITY_RULES.
        keys: float64 (N, A), what a rule that does not look at the clock minimises.
        due: float64 (N,), latest finishes.
        work: float64 (N,), work remaining.
        operations: int64 (N,), operations remaining.
        weights: float64 (N,).
        mean: the mean duration.
    """

    rule: int
    keys: np.ndarray
    due: np.ndarray
    work: np.ndarray
    operations: np.ndarray
    weights: np.ndarray
    mean: float


def urgency_of(problem: Round, rule: str) -> Urgency:
    """What a rule of PRIORITY_RULES ranks the tasks of a problem by; UnknownNameError for another name."""
    code = PRIORITY_RULES.index(require("dispatching rule", rule, PRIORITY_RULES))
    durations, eligible = problem.durations, problem.eligible
    means = np.where(eligible, durations, 0).sum(axis=1) / eligible.sum(axis=1)
    work, operations = remaining(means, *successors(problem.lags))
    due = latest_starts(durations, problem.lags, problem.deadlines, common_horizon(durations))
    due = due + shortest_durations(durations)
    dated = np.where(problem.deadlines == NO_DEADLINE, np.inf, problem.deadlines)
    by_task = {"mwkr": -work, "mopnr": -operations, "edd": due, "edf": dated, "hctf": -problem.weights}
    by_pair = {"spt": durations, "lpt": -durations, "wspt": -problem.weights[:, None] / np.maximum(durations, _LEAST)}
    keys = by_pair[rule] if rule in by_pair else by_task.get(rule, np.zeros(len(due)))[:, None]
    return Urgency(
        rule=code,
        keys=np.ascontiguousarray(np.broadcast_to(keys, durations.shape), np.float64),
        due=due,
        work=work,
        operations=operations,
        weights=problem.weights,
        mean=max(float(means.mean()), _LEAST),
    )


@kernel
def priority(urgency: Urgency, task: int, agent: int, p: int, released: int, clock: int) -> float:
    """What the rule minimises for a task and an agent whose duration is p; see the module's table."""
    if urgency.rule == _FIFO:
        return float(released)
    if urgency.rule == _SLACK:
        return (urgency.due[task] - clock - urgency.work[task]) / urgency.operations[task]
    if urgency.rule == _ATC:
        slack = max(urgency.due[task] - p - clock, 0.0)
        return -urgency.weights[task] / max(float(p), _LEAST) * np.exp(-slack / (LOOK_AHEAD * urgency.mean))
    return urgency.keys[task, agent]


@kernel
def _first_open(
    urgency: Urgency, durations: np.ndarray, agent: int, clock: int, open_: np.ndarray, release: np.ndarray
) -> int:
    """The place in `open_`, int64 (k,), of the task that an agent starts at `clock`, -1 for none."""
    best, least = -1, np.inf
    for k in range(len(open_)):
        task = open_[k]
        if durations[task, agent] < 0 or release[task] > clock:
            continue
        key = priority(urgency, task, agent, durations[task, agent], release[task], clock)
        if best < 0 or key < least or (key == least and task < open_[best]):
            best, least = k, key
    return best


@kernel
def dispatch_rule(
    urgency: Urgency,
    durations: np.ndarray,
    waits: tuple[np.ndarray, np.ndarray, np.ndarray],
    near: np.ndarray,
    free_at: np.ndarray,
    order: np.ndarray,
    count: int,
    doers: np.ndarray,
    finish: np.ndarray,
) -> int:
    """Append to `order`, int64 (N,), of which the first `count` are dispatched.

    durations and near are those of a Round, `waits` is what `successors` returns; doers and finish int64 (N,) hold
    agents and finishes of dispatched tasks and are written, free_at int64 (A,) likewise. Free agents choose in the
    order of their index. Returns how many are dispatched then.
    """
    n, m = durations.shape
    first, waiting, times = waits
    ahead, release, done = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    changed = np.zeros(n, np.bool_)
    for k in range(first[n]):
        ahead[waiting[k]] += 1
    for k in range(count):
        done[order[k]] = True
        release_others(order[k], finish[order[k]], first, waiting, times, near, ahead, release, changed)
    open_ = np.empty(n, np.int64)
    startable = np.flatnonzero(~done & (ahead == 0))
    n_open = len(startable)
    open_[:n_open] = startable
    clock, agent = free_at.min(), 0
    while count < n:
        if agent == m:
            clock, agent = _next_time(clock, free_at, open_, n_open, release), 0
            if clock == _NEVER:
                break
        place = (
            _first_open(urgency, durations, agent, clock, open_[:n_open], release) if free_at[agent] <= clock else -1
        )
        if place < 0:
            agent += 1
            continue
        task = open_[place]
        n_open -= 1
        open_[place] = open_[n_open]
        order[count], doers[task] = task, agent
        count += 1
        finish[task] = free_at[agent] = clock + durations[task, agent]
        release_others(task, finish[task], first, waiting, times, near, ahead, release, changed)
        for k in range(first[task], first[task + 1]):
            if ahead[waiting[k]] == 0:
                open_[n_open] = waiting[k]
                n_open += 1
        agent = 0 if durations[task, agent] == 0 else agent + 1  # nothing may have passed: everybody looks again
    return count


@kernel
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
    """The schedule of a rule of PRIORITY_RULES behind what is committed to; UnknownNameError for another name."""
    urgency, begun = urgency_of(problem, rule), Begun.of(problem)
    count = dispatch_rule(
        urgency, problem.durations, successors(problem.lags), problem.near, begun.free_at, begun.order, begun.count,
        begun.doers, begun.finish,
    )  # fmt: skip
    return begun.plan(problem, count)


class DispatchingRule(PlanningScheduler):
    """Plays a rule of DISPATCHING_RULES; in `online` mode anew whenever a task did not end when it was expected to."""

    plans_on_estimates = True

    def __init__(self, rule: str) -> None:
        super().__init__()
        self.name = require("dispatching rule", rule, DISPATCHING_RULES)

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The rule's schedule of the whole round on estimated durations."""
        return dispatched(estimated_round(simulator, env_index), self.name)

    def revise(self, simulator: MurseSimulator, env_index: int, plan: Plan) -> Plan:
        """The rule's schedule of what is left, where something went otherwise."""
        if simulator.mode == "plan":
            return plan
        problem = remaining_round(simulator, env_index)
        return plan if as_expected(problem, plan) else dispatched(problem, self.name)


def factories() -> dict[str, Callable[[], DispatchingRule]]:
    """The rules as schedulers: name -> what makes one."""
    return {rule: partial(DispatchingRule, rule) for rule in DISPATCHING_RULES}

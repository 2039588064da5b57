"""The rule that the published code calls EDF, and the genetic search that the published code starts from it.

The rule does not rank by deadlines. Time goes on unit by unit. Of the agents that are free the one with the least
mean duration over unscheduled tasks comes first. It takes, of the tasks that can start now, the one with the
smallest earliest finish in the initial network, which knows of no decision: everybody takes their shortest, the
tasks that can start now last as long as this agent needs. If that network is inconsistent, because a deadline or the
horizon (the largest sum of one agent's durations) cannot be held, the agent is passed over until the next decision.
"""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.genetic import GeneticEdf, evolve, swap_order
from marl_sched.agents.murse.problem import Plan, Round, timed
from marl_sched.agents.murse.snapshot import estimated_round
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.timetable import worst_case
from marl_sched.kernels import kernel

NEARBY = 0.5
"""Starts that lie at most this share of the mean duration apart are nearby for the search."""
_UNREACHED = 1 << 60


@kernel
def initial_finishes(
    lasts: np.ndarray, lags: np.ndarray, deadlines: np.ndarray, horizon: int
) -> tuple[bool, np.ndarray]:
    """Whether the initial network is consistent, and the earliest finishes int64 (N,) in it.

    lasts int64 (N,) is each task's least duration; lags (N, N) and deadlines (N,) as in MurseInstance. No resource
    counts: an agent may do any number of tasks at once. Waits must not form a cycle.
    """
    n = len(lasts)
    finish = lasts.copy()
    moved = True
    while moved:
        moved = False
        for i in range(n):
            for j in range(n):
                if lags[i, j] >= 0 and finish[j] + lags[i, j] + lasts[i] > finish[i]:
                    finish[i] = finish[j] + lags[i, j] + lasts[i]
                    moved = True
    consistent = True
    for i in range(n):
        if finish[i] > horizon or (deadlines[i] != NO_DEADLINE and finish[i] > deadlines[i]):
            consistent = False
    return consistent, finish


@kernel
def published_order(
    durations: np.ndarray, lags: np.ndarray, near: np.ndarray, deadlines: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The rule's dispatch order, tasks and agents int64 (K,); K < N where all agents are passed over for good.

    durations int64 (N, A), INELIGIBLE where a pair is; the other arrays as in `initial_finishes`, near bool (N, N).
    """
    n, m = durations.shape
    shortest = np.full(n, _UNREACHED, np.int64)
    ahead, release, finish = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
    for task in range(n):
        for agent in range(m):
            if durations[task, agent] >= 0:
                shortest[task] = min(shortest[task], durations[task, agent])
        for other in range(n):
            ahead[task] += lags[task, other] >= 0
    horizon, clock, count = worst_case(durations), 0, 0
    free_at, done = np.zeros(m, np.int64), np.zeros(n, np.bool_)
    order, doers, passed = np.empty(n, np.int64), np.empty(n, np.int64), np.zeros(m, np.bool_)
    startable = np.zeros(n, np.bool_)
    while count < n:
        for task in range(n):
            startable[task] = not done[task] and ahead[task] == 0 and release[task] <= clock
        agent = _first_choice(durations, done, free_at, clock, passed)
        if agent < 0:
            clock = _next_event(free_at, release, done, ahead, clock)
            if clock == _UNREACHED:
                break
            passed[:] = False
            continue
        lasts = np.where(startable & (durations[:, agent] >= 0), durations[:, agent], shortest)
        consistent, earliest = initial_finishes(lasts, lags, deadlines, horizon)
        task = -1
        for each in range(n):
            if startable[each] and durations[each, agent] >= 0 and (task < 0 or earliest[each] < earliest[task]):
                task = each
        if not consistent or task < 0:
            passed[agent] = True
            continue
        order[count], doers[count], done[task] = task, agent, True
        count += 1
        finish[task] = free_at[agent] = clock + durations[task, agent]
        passed[:] = False
        for other in range(n):
            if lags[other, task] >= 0:
                ahead[other] -= 1
                release[other] = max(release[other], finish[task] + lags[other, task])
            elif near[other, task]:
                release[other] = max(release[other], finish[task])
    return order[:count], doers[:count]


@kernel
def _first_choice(durations: np.ndarray, done: np.ndarray, free_at: np.ndarray, clock: int, passed: np.ndarray) -> int:
    """The free agent of the least mean duration over unscheduled tasks that has not been passed over; -1: none."""
    best, least = -1, np.inf
    for agent in range(len(free_at)):
        if free_at[agent] > clock or passed[agent]:
            continue
        total, able = 0.0, 0
        for task in range(len(done)):
            if not done[task] and durations[task, agent] >= 0:
                total += durations[task, agent]
                able += 1
        mean = total / able if able else np.inf
        if best < 0 or mean < least:
            best, least = agent, mean
    return best


@kernel
def _next_event(free_at: np.ndarray, release: np.ndarray, done: np.ndarray, ahead: np.ndarray, clock: int) -> int:
    """When, after `clock`, the next agent is free or the next task can start; between two events nothing changes."""
    after = _UNREACHED
    for agent in range(len(free_at)):
        if free_at[agent] > clock:
            after = min(after, free_at[agent])
    for task in range(len(done)):
        if not done[task] and ahead[task] == 0 and release[task] > clock:
            after = min(after, release[task])
    return after


def published_schedule(problem: Round) -> Plan:
    """The schedule of the published rule for a whole round."""
    return timed(problem, *published_order(problem.durations, problem.lags, problem.near, problem.deadlines))


class EdfPublished(PlanningScheduler):
    """Plans every round by the published rule on estimated durations."""

    name = "edf-published"

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The rule's schedule."""
        return published_schedule(estimated_round(simulator, env_index))


class GeneticPublished(GeneticEdf):
    """The genetic search as the published code runs it, from the published rule's schedule.

    Its mutants swap two tasks that start at about the same time (NEARBY), or exchange any two pairs of task and
    agent; no task is given to another agent by itself. A round in which the rule gets stuck is played as far as that.
    """

    name = "genetic-published"

    def evolved(self, problem: Round, rng: np.random.Generator) -> Plan:
        """The best schedule found."""
        first = published_schedule(problem)
        if len(first.tasks) < problem.n_tasks:
            return first
        return evolve(problem, rng, *self.options, first=first, mutate=(swap_nearby, swap_order))


def swap_nearby(problem: Round, order: np.ndarray, agents: np.ndarray, rng: np.random.Generator) -> None:
    """Exchange two tasks of nearby starts, drawn at random, between their agents and places, if both are eligible."""
    plan = timed(problem, order, agents)
    reach = NEARBY * problem.durations[problem.eligible].mean()
    place = int(rng.integers(len(order)))
    apart = np.abs(plan.starts[order] - plan.starts[order[place]])
    others = np.flatnonzero((apart <= reach) & (np.arange(len(order)) != place))
    if len(others) == 0:
        return
    other = int(rng.choice(others))
    if problem.eligible[order[place], agents[other]] and problem.eligible[order[other], agents[place]]:
        order[[place, other]] = order[[other, place]]

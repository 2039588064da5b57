"""What a round was worth: its result on true times, and what training is charged for it."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.rules import MAKESPAN, PUBLISHED_REWARD, Rules
from marl_sched.envs.murse.state import NOBODY, State
from marl_sched.envs.murse.timetable import longest_round, worst_case
from marl_sched.kernels import kernel


@kernel
def cost_so_far(state: State, rules: Rules, b: int) -> float:
    """Makespan or weighted completion time of the tasks dispatched so far, as their times stand."""
    row, tasks = state.rows[b], state.tasks[b]
    cost = 0.0
    for k in range(row.dispatched):
        job = tasks[state.order[b, k]]
        cost = max(cost, job.finish) if rules.objective == MAKESPAN else cost + job.weight * job.finish
    return cost


@kernel
def total_weight(state: State, rules: Rules, b: int) -> float:
    """What a time that stands for all tasks is multiplied by: 1, or the sum of weights."""
    return 1.0 if rules.objective == MAKESPAN else state.tasks[b].weight[: state.rows[b].n_tasks].sum()


@kernel
def evaluate_round(state: State, b: int, consistent: bool) -> None:
    """Note in `rounds` and `executed` how the round went, on true times; an inconsistent one is infeasible."""
    row, tasks = state.rows[b], state.tasks[b]
    n, m, result = row.n_tasks, row.n_agents, state.rounds[b, row.round]
    true = state.pairs[b, :n, :m].true
    result.stuck = row.dispatched < n
    result.conflicts = row.conflicts
    result.worst = worst_case(true)
    result.longest = longest_round(true, state.lags[b, :n, :n])
    result.makespan = 0
    result.weighted = 0.0
    late = False
    for k in range(row.dispatched):
        task = state.order[b, k]
        job, done = tasks[task], state.executed[b, row.round, task]
        done.agent, done.position, done.committed = job.agent, k, job.committed
        done.start, done.finish = job.start, job.finish
        result.makespan = max(result.makespan, job.finish)
        late = late or (job.deadline != NO_DEADLINE and job.finish > job.deadline)
    for task in range(n):  # in the order of tasks: rounding shall not tell apart orders of dispatch of the same times
        if state.executed[b, row.round, task].agent != NOBODY:
            result.weighted += tasks[task].weight * tasks[task].finish
    result.feasible = consistent and not result.stuck and not late and result.makespan <= result.longest


@kernel
def published_loss(state: State, rules: Rules, b: int) -> float:
    """Equation 5.2 as published, in which failing can pay better than finishing.

    The cost of the tasks before the first failure, and for the others the longest time that one agent would need
    for them, times the multiplier.
    """
    row, tasks = state.rows[b], state.tasks[b]
    good = np.zeros(row.n_tasks, np.bool_)
    cost = 0.0
    for k in range(row.dispatched):
        job = tasks[state.order[b, k]]
        if job.deadline != NO_DEADLINE and job.finish > job.deadline:
            break
        good[state.order[b, k]] = True
        cost = max(cost, job.finish) if rules.objective == MAKESPAN else cost + job.weight * job.finish
    left = 0.0
    for agent in range(row.n_agents):
        total = 0.0
        for task in range(row.n_tasks):
            if not good[task]:
                own = state.pairs[b, task, agent].true
                own = own if own >= 0 else state.pairs[b, task].true[: row.n_agents].max()
                total += own * (1.0 if rules.objective == MAKESPAN else tasks[task].weight)
        left = max(left, total)
    return cost + rules.multiplier * left


@kernel
def round_cost(state: State, rules: Rules, b: int) -> float:
    """What a judged round costs in training.

    An infeasible round costs, at whatever step it failed, at least as much as the longest feasible one.
    """
    result = state.rounds[b, state.rows[b].round]
    if rules.rewards == PUBLISHED_REWARD and not result.feasible:
        return published_loss(state, rules, b)
    if result.feasible:
        return result.makespan if rules.objective == MAKESPAN else result.weighted
    return max(rules.multiplier * result.worst, float(result.longest)) * total_weight(state, rules, b)

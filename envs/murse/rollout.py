"""The latest-start rule on what somebody knows of a round: the times that bound tasks, and a schedule by them.

Latest starts are propagated backwards through deadlines and waits with everybody's shortest durations; a task that
nothing dates counts against a common horizon. The rule dispatches one pair of task and agent after the other
(Giffler and Thompson 1960): with F the least possible finish of all pairs, it takes, of the tasks that can start before
F on their best agent, or end at F, the one of the least latest start.

Tasks and agents that are not known take no part: a task behind a wait for such a task is never dispatched. Times are
whole units from the round's start.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.kernels import kernel

UNREACHABLE = 1 << 40
"""The start of a task that nobody can start, and the latest start of one that nothing dates."""
HORIZON_SHARE = 1.3
"""The common horizon of undated tasks, in mean loads: all agents' mean durations shared out evenly."""
PRICE_STEPS = 20


class Problem(NamedTuple):
    """What is known of N tasks and A agents; arrays may be longer than what they hold of one round.

    Attributes:
        durations: int64 (N, A), INELIGIBLE where the pair is, or where the task or the agent is unknown.
        lags: int64 (N, N) and `near` bool (N, N), as in MurseInstance.
        deadlines: int64 (N,), NO_DEADLINE for none.
        weights: float64 (N,), costs of the weighted completion time.
        waits: int64 (W, 2), pairs (task, ahead) of open tasks of which the first waits for the second.
    """

    durations: np.ndarray
    lags: np.ndarray
    near: np.ndarray
    deadlines: np.ndarray
    weights: np.ndarray
    waits: np.ndarray


class Progress(NamedTuple):
    """How far a round has come; `roll_out` changes it.

    Attributes:
        open: bool (N,), tasks that are known and have no agent yet.
        missing: int64 (N,), how many tasks without an agent a task waits for, unknown ones included.
        earliest: int64 (N,), the least start that waits and places allow behind what has been dispatched.
        finish: int64 (N,), of the tasks that have an agent.
        ready: int64 (A,), when each agent is free.
    """

    open: np.ndarray
    missing: np.ndarray
    earliest: np.ndarray
    finish: np.ndarray
    ready: np.ndarray


class Plan(NamedTuple):
    """What a roll-out dispatched, in order: int64 (N,) each, of which the first `count` hold."""

    tasks: np.ndarray
    agents: np.ndarray
    starts: np.ndarray


@kernel
def new_progress(n_tasks: int, n_agents: int) -> Progress:
    """Room for N tasks and A agents."""
    times = np.zeros((3, n_tasks), np.int64)
    return Progress(np.zeros(n_tasks, np.bool_), times[0], times[1], times[2], np.zeros(n_agents, np.int64))


@kernel
def new_plan(n_tasks: int) -> Plan:
    """Room for N tasks."""
    arrays = np.zeros((3, n_tasks), np.int64)
    return Plan(arrays[0], arrays[1], arrays[2])


@kernel
def copy_progress(source: Progress, target: Progress) -> None:
    """Write a progress over another of the same sizes."""
    target.open[:] = source.open
    target.missing[:] = source.missing
    target.earliest[:] = source.earliest
    target.finish[:] = source.finish
    target.ready[:] = source.ready


@kernel
def shortest_durations(durations: np.ndarray, shortest: np.ndarray) -> None:
    """Write int64 (N,), the shortest of each row of int64 (N, A); 0 where nobody is eligible."""
    for task in range(len(durations)):
        least = UNREACHABLE
        for agent in range(durations.shape[1]):
            if durations[task, agent] >= 0:
                least = min(least, durations[task, agent])
        shortest[task] = least if least < UNREACHABLE else 0


@kernel
def mean_load(durations: np.ndarray, n_agents: int) -> float:
    """The sum of tasks' mean durations over those who are eligible, int64 (N, A), by number of agents."""
    total = 0.0
    for task in range(len(durations)):
        count, own = 0, 0
        for agent in range(durations.shape[1]):
            if durations[task, agent] >= 0:
                count += 1
                own += durations[task, agent]
        if count > 0:
            total += own / count
    return total / max(n_agents, 1)


@kernel
def latest_starts(problem: Problem, shortest: np.ndarray, horizon: int, latest: np.ndarray) -> None:
    """Write each task's latest start, int64 (N,), so that all open tasks behind it can still be in time.

    shortest int64 (N,) are durations; tasks without a deadline of their own shall end by `horizon`.
    """
    for task in range(len(latest)):
        dated = problem.deadlines[task] != NO_DEADLINE
        latest[task] = (problem.deadlines[task] if dated else horizon) - shortest[task]
    moved = True
    while moved:
        moved = False
        for k in range(len(problem.waits)):
            task, ahead = problem.waits[k]
            bound = latest[task] - problem.lags[task, ahead] - shortest[ahead]
            if bound < latest[ahead]:
                latest[ahead] = bound
                moved = True


@kernel
def tails(problem: Problem, shortest: np.ndarray, tail: np.ndarray) -> None:
    """Write how long the longest chain of waits behind each open task takes after its finish, int64 (N,)."""
    tail[:] = 0
    moved = True
    while moved:
        moved = False
        for k in range(len(problem.waits)):
            task, ahead = problem.waits[k]
            chain = problem.lags[task, ahead] + shortest[task] + tail[task]
            if chain > tail[ahead]:
                tail[ahead] = chain
                moved = True


@kernel
def agent_prices(problem: Problem, progress: Progress, prices: np.ndarray) -> None:
    """Write what a unit of each agent's time is worth, float64 (A,), with mean 1 over those who can do something.

    An approximate dual of sharing out the open tasks so that the last agent to finish does so early: tasks go to whom
    they are cheapest for at present prices, and the prices of those who are loaded more than others rise
    (multiplicative weights, averaged over PRICE_STEPS steps; Plotkin, Shmoys and Tardos 1995).
    """
    n, m = problem.durations.shape
    useful, least = np.zeros(m, np.bool_), UNREACHABLE
    for agent in range(m):
        for task in range(n):
            useful[agent] = useful[agent] or (progress.open[task] and problem.durations[task, agent] >= 0)
        if useful[agent]:
            least = min(least, progress.ready[agent])
    count = useful.sum()
    prices[:] = 0.0
    if count == 0:
        return
    present, load = np.where(useful, 1.0 / count, 0.0), np.zeros(m)
    for step in range(PRICE_STEPS):
        for agent in range(m):
            load[agent] = progress.ready[agent] - least if useful[agent] else 0.0
        for task in range(n):
            if not progress.open[task]:
                continue
            best, cheapest = -1, np.inf
            for agent in range(m):
                cost = problem.durations[task, agent] * present[agent]
                if problem.durations[task, agent] >= 0 and cost < cheapest:
                    best, cheapest = agent, cost
            if best >= 0:
                load[best] += problem.durations[task, best]
        highest = load.max()
        if highest > 0:
            for agent in range(m):
                present[agent] *= np.exp(0.5 / np.sqrt(1.0 + step) * (load[agent] / highest - 0.5))
        present /= present.sum()
        prices += present
    prices *= count / PRICE_STEPS


@kernel
def dispatch(problem: Problem, progress: Progress, task: int, agent: int, moved: np.ndarray) -> int:
    """Give a task to an agent at its earliest start, which is returned; what stands behind it is updated.

    Marks in `moved`, bool (N,), the open tasks for which something has changed.
    """
    start = max(progress.earliest[task], progress.ready[agent])
    finish = start + problem.durations[task, agent]
    progress.open[task] = False
    progress.finish[task] = progress.ready[agent] = finish
    for other in range(len(progress.open)):
        if progress.open[other]:
            lag = problem.lags[other, task]
            if lag >= 0:
                progress.missing[other] -= 1
                progress.earliest[other] = max(progress.earliest[other], finish + lag)
                moved[other] = True
            elif problem.near[other, task] and progress.earliest[other] < finish:
                progress.earliest[other] = finish
                moved[other] = True
    return start


@kernel
def cheapest_costs(problem: Problem, prices: np.ndarray, cheapest: np.ndarray) -> None:
    """Write each task's least price x duration over those who are eligible, float64 (N,); inf without any."""
    for task in range(len(cheapest)):
        cheapest[task] = np.inf
        for agent in range(len(prices)):
            if problem.durations[task, agent] >= 0:
                cheapest[task] = min(cheapest[task], problem.durations[task, agent] * prices[agent])


class Choice(NamedTuple):
    """Each open task's best agent at a moment of a roll-out, int64 (N,) each, and which have to be worked out anew."""

    agent: np.ndarray
    start: np.ndarray
    finish: np.ndarray
    stale: np.ndarray  # bool (N,)


@kernel
def new_choice(n_tasks: int) -> Choice:
    """Room for N tasks."""
    arrays = np.zeros((3, n_tasks), np.int64)
    return Choice(arrays[0], arrays[1], arrays[2], np.zeros(n_tasks, np.bool_))


@kernel
def choose_agent(
    problem: Problem, progress: Progress, task: int, prices: np.ndarray, cheapest: float, charge: float, choice: Choice
) -> None:
    """Write a task's best agent, and when it would start and finish: see `roll_out`."""
    least = np.inf
    choice.agent[task] = -1
    for agent in range(len(prices)):
        duration = problem.durations[task, agent]
        if duration < 0:
            continue
        start = max(progress.earliest[task], progress.ready[agent])
        score = start + duration + charge * (duration * prices[agent] - cheapest)
        if score < least:
            least = score
            choice.agent[task], choice.start[task], choice.finish[task] = agent, start, start + duration
    choice.stale[task] = False


@kernel
def roll_out(
    problem: Problem,
    progress: Progress,
    latest: np.ndarray,
    prices: np.ndarray,
    cheapest: np.ndarray,
    charge: float,
    choice: Choice,
    plan: Plan,
) -> int:
    """Dispatch by the rule what can be dispatched; how many tasks that were.

    A task's best agent is the one of least finish + charge x (price x duration - cheapest), `cheapest` float64 (N,)
    being the least such product of the task; with `charge` 0 the earliest to finish, as the rule has it. latest
    int64 (N,), prices float64 (A,).
    """
    n, count = len(latest), 0
    choice.stale[:n] = True
    while True:
        least_finish = UNREACHABLE
        for task in range(n):
            if progress.open[task] and progress.missing[task] == 0:
                if choice.stale[task]:
                    choose_agent(problem, progress, task, prices, cheapest[task], charge, choice)
                if choice.agent[task] >= 0:
                    least_finish = min(least_finish, choice.finish[task])
        chosen = -1
        for task in range(n):
            if progress.open[task] and progress.missing[task] == 0 and choice.agent[task] >= 0:
                in_time = choice.start[task] < least_finish or choice.finish[task] == least_finish
                if in_time and (chosen < 0 or latest[task] < latest[chosen]):
                    chosen = task
        if chosen < 0:
            return count
        agent = choice.agent[chosen]
        plan.tasks[count], plan.agents[count] = chosen, agent
        plan.starts[count] = dispatch(problem, progress, chosen, agent, choice.stale)
        count += 1
        for task in range(n):
            choice.stale[task] = choice.stale[task] or choice.agent[task] == agent

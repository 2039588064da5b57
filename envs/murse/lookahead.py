"""Features that look ahead: what a viewer can work out about the tasks in sight that nobody has taken yet.

Everything follows from what the viewer knows (marl_sched.envs.murse.views): the tasks in sight, the agents within
hearing, and when those will be free. The latest-start rule is run once on that (marl_sched.envs.murse.rollout); its
schedule, and which choice it comes to, are features too. No choice is tried out by a run of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.envs.murse.graph import (
    BREAKS,
    BROKEN_TIME,
    EARLIEST_START,
    IS_DUE,
    LATEST_START,
    PLANNED_MINE,
    PLANNED_START,
    RANK,
    REDUCED_COST,
    REGRET,
    RULE_CHOICE,
    SLACK,
    TAIL,
    TIME_TO_SPARE,
    UNIT_OF_COUNTS,
    Arrays,
)
from marl_sched.envs.murse.instance import INELIGIBLE
from marl_sched.envs.murse.rollout import (
    HORIZON_SHARE,
    UNREACHABLE,
    Choice,
    Plan,
    Problem,
    Progress,
    agent_prices,
    cheapest_costs,
    copy_progress,
    latest_starts,
    mean_load,
    new_choice,
    new_plan,
    new_progress,
    roll_out,
    shortest_durations,
    tails,
)
from marl_sched.envs.murse.state import State
from marl_sched.envs.murse.views import Sight
from marl_sched.kernels import kernel


class Outlook(NamedTuple):
    """Room for what is worked out of one agent's sight: N tasks, A agents.

    Attributes:
        durations: int64 (N, A), planned, of the tasks in sight and the agents within hearing, else INELIGIBLE.
        deadlines, weights: (N,), as in rollout.Problem.
        shortest: int64 (N,), of `durations`.
        latest: int64 (N,), latest starts, the rule's key.
        due: int64 (N,), the same with nothing but deadlines; beyond UNREACHABLE / 2 where no deadline bears on it.
        tail: int64 (N,), the longest chain of waits behind a task.
        prices: float64 (A,), see rollout.agent_prices.
        now, planned: Progress as things stand, and behind the rule's plan.
        plan: the rule's plan.
        place: int64 (N,), a task's place in it, -1 if it is not in it.
        waits: int64 (N * N, 2), the first n_waits[0] are pairs of open tasks, the first waits for the second.
        cheapest: float64 (N,), see rollout.cheapest_costs.
        finishes: int64 (N, 2), each task's least finish over agents, and the least over those but the best.
        best: int64 (N,), the agent of the least finish.
        helpers: int64 (N,), when the first of the others than the viewer is ready who could start a task.
        choice: room for roll-outs.
    """

    durations: np.ndarray
    deadlines: np.ndarray
    weights: np.ndarray
    shortest: np.ndarray
    latest: np.ndarray
    due: np.ndarray
    tail: np.ndarray
    prices: np.ndarray
    now: Progress
    planned: Progress
    plan: Plan
    place: np.ndarray
    waits: np.ndarray
    n_waits: np.ndarray
    cheapest: np.ndarray
    finishes: np.ndarray
    best: np.ndarray
    helpers: np.ndarray
    choice: Choice


@kernel
def new_outlook(state: State) -> Outlook:
    """Room for an outlook on any row of a state."""
    n, m = state.tasks.shape[1], state.agents.shape[1]
    times = np.zeros((8, n), np.int64)
    return Outlook(
        np.zeros((n, m), np.int64), times[0], np.zeros(n), times[1], times[2], times[3], times[4], np.zeros(m),
        new_progress(n, m), new_progress(n, m), new_plan(n), times[5],
        np.zeros((n * n, 2), np.int64), np.zeros(1, np.int64), np.zeros(n), np.zeros((n, 2), np.int64), times[6],
        times[7], new_choice(n),
    )  # fmt: skip


@kernel
def problem_of(state: State, b: int, outlook: Outlook) -> Problem:
    """What is known of row b as the rule takes it, without the padding of tasks."""
    n, m = state.rows[b].n_tasks, state.rows[b].n_agents
    return Problem(
        outlook.durations[:n, :m], state.lags[b, :n, :n], state.near[b, :n, :n], outlook.deadlines[:n],
        outlook.weights[:n], outlook.waits[: outlook.n_waits[0]],
    )  # fmt: skip


@kernel
def without_padding(progress: Progress, n: int, m: int) -> Progress:
    """The same memory, cut to n tasks and m agents."""
    return Progress(
        progress.open[:n], progress.missing[:n], progress.earliest[:n], progress.finish[:n], progress.ready[:m]
    )


@kernel
def take_stock(state: State, b: int, sight: Sight, margin: float, outlook: Outlook) -> None:
    """Write what is known and how far the round has come: durations, deadlines and `now`.

    `margin` standard deviations of each duration are added to it, rounded to whole units.
    """
    row, now = state.rows[b], outlook.now
    n, m = row.n_tasks, row.n_agents
    now.ready[:m] = row.clock
    for task in range(n):
        job = state.tasks[b, task]
        outlook.deadlines[task], outlook.weights[task] = job.deadline, job.weight
        now.open[task] = sight.seen[task] and not sight.known[task]
        now.finish[task] = sight.finish[task] if sight.known[task] else 0
        if sight.known[task] and sight.heard[job.agent]:
            now.ready[job.agent] = max(now.ready[job.agent], sight.finish[task])
        for agent in range(m):
            usable = sight.seen[task] and sight.heard[agent] and state.pairs[b, task, agent].true >= 0
            pair = state.pairs[b, task, agent]
            longer = int(np.rint(margin * pair.spread)) if usable else 0
            outlook.durations[task, agent] = pair.planned + longer if usable else INELIGIBLE
    count, lags, near = 0, state.lags[b], state.near[b]
    for task in range(n):
        now.missing[task], now.earliest[task] = 0, row.clock
        if not now.open[task]:
            continue
        for other in range(n):
            lag = lags[task, other]
            if lag >= 0 and not sight.known[other]:
                now.missing[task] += 1
                if now.open[other]:
                    outlook.waits[count, 0], outlook.waits[count, 1] = task, other
                    count += 1
            elif lag >= 0:
                now.earliest[task] = max(now.earliest[task], now.finish[other] + lag)
            elif near[task, other] and sight.known[other] and sight.seen[other]:
                now.earliest[task] = max(now.earliest[task], now.finish[other])
    outlook.n_waits[0] = count


@kernel
def work_out(state: State, b: int, sight: Sight, margin: float, outlook: Outlook) -> int:
    """Fill an outlook from what a viewer knows; how many tasks the rule's plan dispatches. `margin`: see take_stock."""
    take_stock(state, b, sight, margin, outlook)
    n, m = state.rows[b].n_tasks, state.rows[b].n_agents
    problem, now = problem_of(state, b, outlook), without_padding(outlook.now, n, m)
    shortest, latest, due = outlook.shortest[:n], outlook.latest[:n], outlook.due[:n]
    shortest_durations(problem.durations, shortest)
    horizon = HORIZON_SHARE * mean_load(problem.durations, sight.heard[:m].sum())
    latest_starts(problem, shortest, int(horizon), latest)
    latest_starts(problem, shortest, UNREACHABLE, due)
    tails(problem, shortest, outlook.tail[:n])
    agent_prices(problem, now, outlook.prices[:m])
    cheapest_costs(problem, outlook.prices[:m], outlook.cheapest[:n])
    planned = without_padding(outlook.planned, n, m)
    copy_progress(now, planned)
    count = roll_out(
        problem, planned, latest, outlook.prices[:m], outlook.cheapest[:n], 0.0, outlook.choice, outlook.plan
    )
    outlook.place[:] = -1
    for k in range(count):
        outlook.place[outlook.plan.tasks[k]] = k
    return count


@kernel
def rule_target(state: State, b: int, viewer: int, count: int, outlook: Outlook) -> int:
    """What the rule has the viewer do now: the slot of its next task in the plan, or 0.

    It waits if it has none, if that task still waits for one that is not dispatched, or if the plan has somebody
    else dispatch a task nearby before.
    """
    for k in range(count):
        task = outlook.plan.tasks[k]
        if outlook.plan.agents[k] != viewer:
            continue
        if outlook.now.missing[task] > 0:
            return 0
        for ahead in range(k):
            if state.near[b, task, outlook.plan.tasks[ahead]]:
                return 0
        return task + 1
    return 0


@kernel
def next_event(state: State, b: int, sight: Sight) -> int:
    """When, as far as the viewer knows, the next task ends or wait elapses; UNREACHABLE if none does."""
    row, wakes = state.rows[b], UNREACHABLE
    for done in range(row.n_tasks):
        if not sight.known[done]:
            continue
        finish = sight.finish[done]
        if finish > row.clock:
            wakes = min(wakes, finish)
        for task in range(row.n_tasks):
            lag = state.lags[b, task, done]
            if lag > 0 and sight.seen[task] and finish + lag > row.clock:
                wakes = min(wakes, finish + lag)
    return wakes


@kernel
def finish_by(task: int, agent: int, outlook: Outlook) -> int:
    """When an eligible agent would finish a task at the earliest."""
    return max(outlook.now.earliest[task], outlook.now.ready[agent]) + outlook.durations[task, agent]


@kernel
def compare_agents(viewer: int, n_tasks: int, n_agents: int, outlook: Outlook) -> None:
    """Write `finishes`, `best` and `helpers` of the open tasks."""
    for task in range(n_tasks):
        least, second, best, helper = UNREACHABLE, UNREACHABLE, -1, UNREACHABLE
        if outlook.now.open[task]:
            for agent in range(n_agents):
                if outlook.durations[task, agent] >= 0:
                    finish = finish_by(task, agent, outlook)
                    if finish < least:
                        least, second, best = finish, least, agent
                    else:
                        second = min(second, finish)
                    if agent != viewer:
                        helper = min(helper, outlook.now.ready[agent])
        outlook.finishes[task, 0], outlook.finishes[task, 1] = least, second
        outlook.best[task], outlook.helpers[task] = best, helper


@kernel
def regret_of(task: int, agent: int, outlook: Outlook) -> int:
    """How much later `agent` would finish a task than the best of the others; 0 if nobody else can."""
    rival = outlook.finishes[task, 1 if outlook.best[task] == agent else 0]
    return finish_by(task, agent, outlook) - rival if rival < UNREACHABLE else 0


@kernel
def reduced_cost(task: int, agent: int, outlook: Outlook) -> float:
    """Price x duration of a pair less the least such product of the task."""
    return outlook.prices[agent] * outlook.durations[task, agent] - outlook.cheapest[task]


@kernel
def breaks(
    lags: np.ndarray, near: np.ndarray, n_tasks: int, viewer: int, taken: int, until: int, outlook: Outlook
) -> tuple[int, int]:
    """How many open tasks miss their due latest start if the viewer is busy until then, and by how much in all.

    `taken` is the task that it takes, -1 if it waits; lags and near (N, N) as in MurseInstance. Those that miss it
    anyway are not counted.
    """
    count, total, now = 0, 0, outlook.now
    for task in range(n_tasks):
        if outlook.due[task] > UNREACHABLE // 2 or not now.open[task] or task == taken:
            continue
        before = after = outlook.helpers[task]
        if outlook.durations[task, viewer] >= 0:
            before, after = min(before, now.ready[viewer]), min(after, until)
        before, after = max(before, now.earliest[task]), max(after, now.earliest[task])
        if taken >= 0:
            if lags[task, taken] >= 0:
                after = max(after, until + lags[task, taken])
            elif near[task, taken]:
                after = max(after, until)
        if before <= outlook.due[task] < after and after < UNREACHABLE:
            count += 1
            total += after - outlook.due[task]
    return count, total


@kernel
def see_ahead(state: State, b: int, viewer: int, sight: Sight, outlook: Outlook, out: Arrays) -> None:
    """Write the features that look ahead of tasks, pairs, agents and the state; the action mask is there already."""
    count = work_out(state, b, sight, 0.0, outlook)
    row, unit = state.rows[b], state.rows[b].high
    n, m, clock = row.n_tasks, row.n_agents, row.clock
    compare_agents(viewer, n, m, outlook)
    for task in range(n):
        if outlook.now.open[task]:
            describe_open_task(out.task[b, task + 1], task, viewer, clock, unit, outlook)
            for agent in range(m):
                if outlook.durations[task, agent] >= 0:
                    there, back = (
                        out.use_time_attributes[b, task + 1, agent],
                        out.take_time_attributes[b, agent, task + 1],
                    )
                    there[2] = back[2] = (finish_by(task, agent, outlook) - clock) / unit
                    there[3] = back[3] = regret_of(task, agent, outlook) / unit
                    there[4] = back[4] = reduced_cost(task, agent, outlook) / unit
    for k in range(count):
        features = out.task[b, outlook.plan.tasks[k] + 1]
        features[PLANNED_START] = (outlook.plan.starts[k] - clock) / unit
        features[PLANNED_MINE] = outlook.plan.agents[k] == viewer
    describe_choices(state, b, viewer, sight, count, outlook, out)
    describe_plan(state, b, sight, outlook, out)


@kernel
def describe_open_task(features: np.ndarray, task: int, viewer: int, clock: int, unit: int, outlook: Outlook) -> None:
    """The bounds of an open task, and how the viewer would do it beside the others."""
    features[LATEST_START] = (outlook.latest[task] - clock) / unit
    features[SLACK] = (outlook.latest[task] - outlook.now.earliest[task]) / unit
    features[TAIL] = outlook.tail[task] / unit
    if outlook.due[task] < UNREACHABLE // 2:
        features[IS_DUE] = 1.0
        features[TIME_TO_SPARE] = (outlook.due[task] - outlook.now.earliest[task]) / unit
    if outlook.durations[task, viewer] >= 0:
        features[REGRET] = regret_of(task, viewer, outlook) / unit
        features[REDUCED_COST] = reduced_cost(task, viewer, outlook) / unit


@kernel
def describe_choices(
    state: State, b: int, viewer: int, sight: Sight, count: int, outlook: Outlook, out: Arrays
) -> None:
    """What the rule chooses, how it ranks the choices, and what each would break.

    The rule's own choice has rank 0, the other legal tasks follow in the order of their latest starts, ties by index;
    if it does not wait, waiting ranks behind those that the viewer can start at once.
    """
    row, unit = state.rows[b], state.rows[b].high
    n, clock, mask, lags, near = row.n_tasks, row.clock, out.action_mask[b], state.lags[b], state.near[b]
    chosen = rule_target(state, b, viewer, count, outlook)
    out.task[b, chosen, RULE_CHOICE] = 1.0
    startable = 0
    for task in range(n):
        if mask[task + 1] == 0:
            continue
        startable += task + 1 != chosen and outlook.now.earliest[task] <= clock
        rank = 0
        for other in range(n):
            if mask[other + 1] == 1 and other != task:
                sooner = outlook.latest[other] < outlook.latest[task]
                tied = outlook.latest[other] == outlook.latest[task] and other < task
                rank += other + 1 == chosen or sooner or tied
        features = out.task[b, task + 1]
        features[RANK] = 0.0 if task + 1 == chosen else (rank + (chosen == 0)) / UNIT_OF_COUNTS
        broken, by = breaks(lags, near, n, viewer, task, finish_by(task, viewer, outlook), outlook)
        features[BREAKS], features[BROKEN_TIME] = broken / UNIT_OF_COUNTS, by / unit
    waiting = out.task[b, 0]
    wakes = next_event(state, b, sight)
    waiting[RANK] = 0.0 if chosen == 0 else (1 + startable) / UNIT_OF_COUNTS
    if wakes < UNREACHABLE:
        broken, by = breaks(lags, near, n, viewer, -1, wakes, outlook)
        waiting[EARLIEST_START] = (wakes - clock) / unit
        waiting[BREAKS], waiting[BROKEN_TIME] = broken / UNIT_OF_COUNTS, by / unit


@kernel
def describe_plan(state: State, b: int, sight: Sight, outlook: Outlook, out: Arrays) -> None:
    """What agents' time is worth, when the plan has them done, and how it ends as a whole."""
    row, unit, last, late = state.rows[b], state.rows[b].high, state.rows[b].clock, 0
    for agent in range(row.n_agents):
        if sight.heard[agent]:
            out.agent[b, agent, 7] = outlook.prices[agent]
            out.agent[b, agent, 8] = (outlook.planned.ready[agent] - row.clock) / unit
            last = max(last, outlook.planned.ready[agent])
    for task in range(row.n_tasks):
        if outlook.place[task] >= 0 and outlook.deadlines[task] >= 0:
            late += max(outlook.planned.finish[task] - outlook.deadlines[task], 0)
    out.state[b, 9] = (last - row.clock) / unit
    out.state[b, 10] = late / unit

"""What HybridNet and HetGAT see of a round: features of tasks, agents, pairs, locations and the state, and edges.

All times are divided by one horizon of the round, the larger of its mean load (all agents' mean durations, shared out
evenly) and its latest deadline. Latest starts, tails and the rule's schedule are those of marl_sched.envs.murse.rollout
on what is left of the round; the rule's schedule is the cheaper one of CHARGES, as in `lst-rollout`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.agents.murse.networks.hybridnet.rounds import OPEN, Partial, Rounds, problem_of_row
from marl_sched.agents.murse.rollout import CHARGES, cost_of
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.rollout import (
    HORIZON_SHARE,
    UNREACHABLE,
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
from marl_sched.envs.murse.rules import MAKESPAN
from marl_sched.kernels import kernel

TASK_FEATURES = (
    "open", "has_deadline", "deadline", "latest_start", "earliest_start", "slack", "tail", "min_duration",
    "mean_duration", "max_duration", "std_duration", "mean_spread", "waits_unheeded", "waited_for", "work_near",
    "rank", "planned_start", "planned_finish", "planned_lateness", "weight", "start", "finish", "is_due",
    "time_to_spare",
)  # fmt: skip
AGENT_FEATURES = (
    "robot", "human", "mean_duration", "fastest_share", "price", "ready", "tasks_share", "planned_finish",
)  # fmt: skip
PAIR_FEATURES = (
    "eligible", "mean", "spread", "repetitions/10", "regret", "reduced_cost", "planned", "finish", "start_gap",
    "finish_gap", "breaks/10", "broken_time",
)  # fmt: skip
STATE_FEATURES = (
    "tasks/40", "agents/5", "tasks_per_agent/10", "mean_load", "deadline_share", "wait_share", "dispatched_share",
    "planned_makespan", "planned_lateness", "robot_share",
)  # fmt: skip
LOCATION_FEATURES = ("tasks_share", "open_share", "open_work")


class Features(NamedTuple):
    """Float32 features of R rounds, and what decisions are masked and biased by.

    Attributes:
        task: (R, N, TASK_FEATURES), agent: (R, A, AGENT_FEATURES), location: (R, N, LOCATION_FEATURES).
        pair: (R, N, A, PAIR_FEATURES), state: (R, STATE_FEATURES).
        bound: float32 (R, N, N), [i, j] the bound on starts where task i waits for j (section 5.4.1), else 0.
        waits: bool (R, N, N), [i, j] that task i waits for j.
        located: bool (R, N, N), [i, l] that task i is at location l; near: bool (R, N, N), of locations.
        assigned: bool (R, N, A), who has which task.
        eligible: bool (R, N, A).
        latest_rank: int64 (R, N), of open tasks by latest start; rule_position int64 (R, N), rule_agent int64 (R, N),
            of open tasks in the rule's schedule, by start.
        rule_cost: float64 (R,), what the round costs if the rule completes it (`cost_of` of lst-rollout).
    """

    task: np.ndarray
    agent: np.ndarray
    location: np.ndarray
    pair: np.ndarray
    state: np.ndarray
    bound: np.ndarray
    waits: np.ndarray
    located: np.ndarray
    near: np.ndarray
    assigned: np.ndarray
    eligible: np.ndarray
    latest_rank: np.ndarray
    rule_position: np.ndarray
    rule_agent: np.ndarray
    rule_cost: np.ndarray


def take_features(features: Features, rows: np.ndarray) -> Features:
    """Those of some rows, int64 (K,)."""
    return Features(*[array[rows] for array in features])


def features_of(rounds: Rounds, partial: Partial) -> Features:
    """The features of rounds of which something has been dispatched."""
    r, n, m = rounds.shape
    out = Features(
        task=np.zeros((r, n, len(TASK_FEATURES)), np.float32),
        agent=np.zeros((r, m, len(AGENT_FEATURES)), np.float32),
        location=np.zeros((r, n, len(LOCATION_FEATURES)), np.float32),
        pair=np.zeros((r, n, m, len(PAIR_FEATURES)), np.float32),
        state=np.zeros((r, len(STATE_FEATURES)), np.float32),
        bound=np.zeros((r, n, n), np.float32),
        waits=rounds.lags >= 0,
        located=np.zeros((r, n, n), np.bool_),
        near=np.zeros((r, n, n), np.bool_),
        assigned=partial.agents[:, :, None] == np.arange(m),
        eligible=rounds.durations >= 0,
        latest_rank=np.zeros((r, n), np.int64),
        rule_position=np.zeros((r, n), np.int64),
        rule_agent=np.full((r, n), OPEN),
        rule_cost=np.zeros(r),
    )
    write_features(rounds, partial, out)
    return out


@kernel
def write_features(rounds: Rounds, partial: Partial, out: Features) -> None:
    """Write all rows; arrays must be zeroed and of one batch."""
    for r in range(len(rounds.durations)):
        problem, progress = problem_of_row(rounds, partial, r)
        n, m = problem.durations.shape
        shortest, latest, tail = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
        prices, cheapest = np.zeros(m), np.zeros(n)
        load = mean_load(problem.durations, m)
        shortest_durations(problem.durations, shortest)
        latest_starts(problem, shortest, int(HORIZON_SHARE * load), latest)
        tails(problem, shortest, tail)
        agent_prices(problem, progress, prices)
        cheapest_costs(problem, prices, cheapest)
        plan, then = new_plan(n), new_progress(n, m)
        count, out.rule_cost[r] = rule_schedule(problem, progress, latest, prices, cheapest, plan, then)
        unit = horizon(problem, load)
        write_tasks(rounds, partial, r, problem, progress, shortest, latest, tail, unit, out)
        write_plan(r, problem, plan, then, count, unit, out)
        write_pairs(rounds, partial, r, problem, progress, prices, cheapest, unit, out)
        latest_starts(problem, shortest, UNREACHABLE, latest)
        write_breaks(r, problem, progress, latest, unit, out)
        write_edges(rounds, r, problem, progress, shortest, unit, out)
        state = out.state[r]
        state[0], state[1], state[2] = n / 40.0, m / 5.0, n / m / 10.0
        state[3], state[9] = load / unit, rounds.sizes[r, 2] / m
        state[5], state[6] = len(problem.waits) / n, 1.0 - progress.open.sum() / n


@kernel
def horizon(problem: Problem, load: float) -> float:
    """What times are divided by: the larger of the mean load and the latest deadline."""
    unit = max(load, 1.0)
    for task in range(len(problem.deadlines)):
        if problem.deadlines[task] != NO_DEADLINE:
            unit = max(unit, float(problem.deadlines[task]))
    return unit


@kernel
def rule_schedule(
    problem: Problem,
    progress: Progress,
    latest: np.ndarray,
    prices: np.ndarray,
    cheapest: np.ndarray,
    plan: Plan,
    then: Progress,
) -> tuple[int, float]:
    """Write the cheaper one of the rule's schedules of the rest (CHARGES) and where it leads; its length and cost."""
    n, m = problem.durations.shape
    trial, choice, least, count = new_plan(n), new_choice(n), np.inf, 0
    after = new_progress(n, m)
    for charge in CHARGES:
        copy_progress(progress, after)
        found = roll_out(problem, after, latest, prices, cheapest, charge, choice, trial)
        cost = cost_of(problem, after, MAKESPAN)
        if cost < least:
            least, count = cost, found
            plan.tasks[:], plan.agents[:], plan.starts[:] = trial.tasks, trial.agents, trial.starts
            copy_progress(after, then)
    return count, least


@kernel
def write_tasks(
    rounds: Rounds,
    partial: Partial,
    r: int,
    problem: Problem,
    progress: Progress,
    shortest: np.ndarray,
    latest: np.ndarray,
    tail: np.ndarray,
    unit: float,
    out: Features,
) -> None:
    """Features of tasks by themselves, and their ranks by latest start, ties by index."""
    n, m = problem.durations.shape
    weights = max(problem.weights.sum(), 1e-9)
    for task in range(n):
        row, able, longest, total, squares, spread = out.task[r, task], 0, 0, 0.0, 0.0, 0.0
        for agent in range(m):
            lasts = problem.durations[task, agent]
            if lasts >= 0:
                able += 1
                longest = max(longest, lasts)
                total += lasts
                squares += lasts * lasts
                spread += rounds.spreads[r, task, agent]
        mean = total / max(able, 1)
        row[0], row[7], row[8], row[9] = progress.open[task], shortest[task] / unit, mean / unit, longest / unit
        row[10] = np.sqrt(max(squares / max(able, 1) - mean * mean, 0.0)) / unit
        row[11], row[19] = spread / max(able, 1) / unit, problem.weights[task] * n / weights
        if problem.deadlines[task] != NO_DEADLINE:
            row[1], row[2] = 1.0, problem.deadlines[task] / unit
        if not progress.open[task]:
            row[20], row[21] = partial.start[r, task] / unit, progress.finish[task] / unit
            continue
        earliest = max(progress.earliest[task], progress.ready.min())
        row[3], row[4] = latest[task] / unit, earliest / unit
        row[5], row[6], row[12] = (latest[task] - earliest) / unit, tail[task] / unit, progress.missing[task]
        rank = 0
        for other in range(n):
            if progress.open[other]:
                earlier = latest[other] < latest[task] or (latest[other] == latest[task] and other < task)
                rank += earlier
                row[13] += problem.lags[other, task] >= 0
                row[14] += shortest[other] / unit if problem.near[task, other] else 0.0
        out.latest_rank[r, task], row[15] = rank, rank / n


@kernel
def write_plan(r: int, problem: Problem, plan: Plan, then: Progress, count: int, unit: float, out: Features) -> None:
    """What the rule's schedule of the rest says of tasks, agents, pairs and the state."""
    last, lateness = 0, 0.0
    for task in range(len(then.finish)):
        last = max(last, then.finish[task])
        if problem.deadlines[task] != NO_DEADLINE:
            lateness += max(then.finish[task] - problem.deadlines[task], 0)
            out.state[r, 4] += 1.0 / len(then.finish)
    for k in range(count):
        task, agent = plan.tasks[k], plan.agents[k]
        place = 0  # by start, then in the order of dispatch
        for other in range(count):
            place += plan.starts[other] < plan.starts[k] or (plan.starts[other] == plan.starts[k] and other < k)
        out.rule_position[r, task], out.rule_agent[r, task] = place, agent
        row = out.task[r, task]
        row[16], row[17] = plan.starts[k] / unit, then.finish[task] / unit
        if problem.deadlines[task] != NO_DEADLINE:
            row[18] = (then.finish[task] - problem.deadlines[task]) / unit
        out.pair[r, task, agent, 6] = 1.0
    out.state[r, 7], out.state[r, 8] = last / unit, lateness / unit
    for agent in range(len(then.ready)):
        out.agent[r, agent, 7] = then.ready[agent] / unit


@kernel
def write_pairs(
    rounds: Rounds,
    partial: Partial,
    r: int,
    problem: Problem,
    progress: Progress,
    prices: np.ndarray,
    cheapest: np.ndarray,
    unit: float,
    out: Features,
) -> None:
    """Features of pairs of task and agent, and of agents."""
    n, m = problem.durations.shape
    for agent in range(m):
        row, able = out.agent[r, agent], 0
        row[0], row[1] = agent < rounds.sizes[r, 2], agent >= rounds.sizes[r, 2]
        row[4], row[5] = prices[agent], progress.ready[agent] / unit
        for task in range(n):
            lasts = problem.durations[task, agent]
            row[6] += (partial.agents[r, task] == agent) / n
            if lasts < 0:
                continue
            able += 1
            row[2] += lasts / unit
            other = -1
            for rival in range(m):
                takes = problem.durations[task, rival]
                if rival != agent and takes >= 0 and (other < 0 or takes < other):
                    other = takes
            row[3] += (other < 0 or lasts <= other) / n
            pair = out.pair[r, task, agent]
            pair[0], pair[1], pair[2] = 1.0, lasts / unit, rounds.spreads[r, task, agent] / unit
            pair[3] = rounds.repetitions[r, task, agent] / 10.0
            pair[4] = (lasts - other) / unit if other >= 0 else 0.0
            pair[5] = (prices[agent] * lasts - cheapest[task]) / unit if progress.open[task] else 0.0
            begin = max(progress.ready[agent], progress.earliest[task])
            pair[7] = (begin + lasts) / unit if progress.open[task] else progress.finish[task] / unit
        row[2] /= max(able, 1)


@kernel
def soonest_agents(problem: Problem, progress: Progress, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Who of those who are eligible for each task is ready first, int64 (N,).

    Writes when that one and the next one are ready, int64 (N,) each, UNREACHABLE for nobody.
    """
    whose = np.zeros(len(first), np.int64)
    first[:], second[:] = UNREACHABLE, UNREACHABLE
    for task in range(len(first)):
        for agent in range(len(progress.ready)):
            ready = progress.ready[agent]
            if problem.durations[task, agent] >= 0 and ready < first[task]:
                first[task], second[task], whose[task] = ready, first[task], agent
            elif problem.durations[task, agent] >= 0:
                second[task] = min(second[task], ready)
    return whose


@kernel
def write_breaks(r: int, problem: Problem, progress: Progress, latest: np.ndarray, unit: float, out: Features) -> None:
    """What taking a pair next would do to deadlines, by `latest` starts, int64 (N,), that follow from deadlines alone.

    Gaps are how much later than the earliest of all pairs that could be next a pair starts and finishes.
    """
    n, m = problem.durations.shape
    first, second = np.empty(n, np.int64), np.empty(n, np.int64)
    whose = soonest_agents(problem, progress, first, second)
    due = progress.open & (latest < UNREACHABLE // 2)
    now, starts, ends = np.maximum(first, progress.earliest), UNREACHABLE, UNREACHABLE
    for task in range(n):
        if due[task]:
            out.task[r, task, 22], out.task[r, task, 23] = 1.0, (latest[task] - now[task]) / unit
        for agent in range(m):
            if progress.open[task] and progress.missing[task] == 0 and problem.durations[task, agent] >= 0:
                begin = max(progress.ready[agent], progress.earliest[task])
                starts, ends = min(starts, begin), min(ends, begin + problem.durations[task, agent])
    for task in range(n):
        for agent in range(m):
            if progress.open[task] and progress.missing[task] == 0 and problem.durations[task, agent] >= 0:
                begin = max(progress.ready[agent], progress.earliest[task])
                finish, pair = begin + problem.durations[task, agent], out.pair[r, task, agent]
                pair[8], pair[9] = (begin - starts) / unit, (finish - ends) / unit
                ready = np.where(whose == agent, np.minimum(second, finish), first)
                broken, late = breaks_behind(problem, progress, task, finish, due, latest, now, ready)
                pair[10], pair[11] = broken / 10.0, late / unit


@kernel
def breaks_behind(
    problem: Problem,
    progress: Progress,
    task: int,
    finish: int,
    due: np.ndarray,
    latest: np.ndarray,
    now: np.ndarray,
    ready: np.ndarray,
) -> tuple[int, int]:
    """How many other due tasks, bool (N,), could start in time now and cannot behind `task`, and by how much in all.

    int64 (N,): `latest` starts, the soonest ones `now`, and when somebody would be `ready` for each behind it.
    """
    broken, late = 0, 0
    for other in range(len(due)):
        if not due[other] or other == task:
            continue
        behind = max(ready[other], progress.earliest[other])
        if problem.lags[other, task] >= 0:
            behind = max(behind, finish + problem.lags[other, task])
        elif problem.near[other, task]:
            behind = max(behind, finish)
        if behind > latest[other]:
            broken += now[other] <= latest[other]
            late += behind - max(now[other], latest[other])
    return broken, late


@kernel
def write_edges(
    rounds: Rounds, r: int, problem: Problem, progress: Progress, shortest: np.ndarray, unit: float, out: Features
) -> None:
    """Bounds between tasks that wait for one another, and locations with what is done there."""
    n = len(shortest)
    for task in range(n):
        place = rounds.places[r, task]
        out.located[r, task, place] = True
        location = out.location[r, place]
        location[0] += 1.0 / n
        if progress.open[task]:
            location[1] += 1.0 / n
            location[2] += shortest[task] / unit
        for other in range(n):
            if problem.lags[task, other] >= 0:
                out.bound[r, task, other] = -(problem.lags[task, other] + shortest[other]) / unit
            if problem.near[task, other]:
                out.near[r, place, rounds.places[r, other]] = True

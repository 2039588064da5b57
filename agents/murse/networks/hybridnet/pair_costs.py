"""What every next pair of a partial schedule costs if the rule completes the rest: what `lst-rollout` chooses by."""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.networks.hybridnet.rounds import Partial, Rounds, problem_of_row
from marl_sched.agents.murse.rollout import CHARGES, cost_of
from marl_sched.envs.murse.rollout import (
    HORIZON_SHARE,
    agent_prices,
    cheapest_costs,
    copy_progress,
    dispatch,
    latest_starts,
    mean_load,
    new_choice,
    new_plan,
    new_progress,
    roll_out,
    shortest_durations,
)
from marl_sched.envs.murse.rules import MAKESPAN
from marl_sched.kernels import kernel


@kernel
def pair_costs(rounds: Rounds, partial: Partial) -> np.ndarray:
    """Float64 (R, A, N), in time units by `cost_of`; inf for pairs that cannot be next.

    The rest is completed by the latest-start rule for each of CHARGES, the cheaper completion counts.
    """
    rows, tasks, agents = rounds.durations.shape
    costs = np.full((rows, agents, tasks), np.inf)
    for r in range(rows):
        problem, now = problem_of_row(rounds, partial, r)
        n, m = problem.durations.shape
        shortest, latest = np.zeros(n, np.int64), np.zeros(n, np.int64)
        prices, cheapest = np.zeros(m), np.zeros(n)
        shortest_durations(problem.durations, shortest)
        latest_starts(problem, shortest, int(HORIZON_SHARE * mean_load(problem.durations, m)), latest)
        agent_prices(problem, now, prices)
        cheapest_costs(problem, prices, cheapest)
        choice, plan, then = new_choice(n), new_plan(n), new_progress(n, m)
        for task in range(n):
            if not now.open[task] or now.missing[task] > 0:
                continue
            for agent in range(m):
                if problem.durations[task, agent] < 0:
                    continue
                for charge in CHARGES:
                    copy_progress(now, then)
                    dispatch(problem, then, task, agent, choice.stale)
                    roll_out(problem, then, latest, prices, cheapest, charge, choice, plan)
                    costs[r, agent, task] = min(costs[r, agent, task], cost_of(problem, then, MAKESPAN))
    return costs

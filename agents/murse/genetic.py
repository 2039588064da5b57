"""GeneticEDF: EDF's schedule bettered by mutation and selection (section 5.7.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.list_schedule import edf_schedule
from marl_sched.agents.murse.problem import Plan, Round, timed
from marl_sched.agents.murse.snapshot import estimated_round
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.timetable import time_batch
from marl_sched.errors import InvalidOptionError


class GeneticEdf(PlanningScheduler):
    """Improves EDF's schedule of every round on estimated durations; see `evolve` for the options."""

    name = "genetic-edf"

    def __init__(self, generations: int = 10, baselines: int = 90, mutations: int = 10) -> None:
        super().__init__()
        for name, value in (("generations", generations), ("baselines", baselines), ("mutations", mutations)):
            if value < 1:
                raise InvalidOptionError(f"{self.name}: {name}: expected an integer >= 1, got {value}")
        self.options = generations, baselines, mutations

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The best schedule found; its randomness is that of the row's episode and round."""
        rows = simulator.state.rows
        rng = np.random.default_rng([int(rows["episode"][env_index]), int(rows["round"][env_index])])
        return self.evolved(estimated_round(simulator, env_index), rng)

    def evolved(self, problem: Round, rng: np.random.Generator) -> Plan:
        """The best schedule found from EDF's."""
        mutate = (reallocate, swap_order)
        return evolve(problem, rng, *self.options, first=edf_schedule(problem), mutate=mutate)


Mutation = Callable[[Round, np.ndarray, np.ndarray, np.random.Generator], None]
"""Changes an order of dispatch and its agents, int64 (N,) each, in place."""


def evolve(
    problem: Round,
    rng: np.random.Generator,
    generations: int,
    baselines: int,
    mutations: int,
    *,
    first: Plan,
    mutate: Sequence[Mutation],
) -> Plan:
    """The best schedule of a genetic search that starts from `first`, a whole and consistent one.

    Each of `generations` adds `mutations` schedules by every way to `mutate`, of baselines drawn at random, and keeps
    the best `baselines`. Feasible schedules come first, then those with the smaller makespan, ties to the older one.
    """
    orders, agents = first.tasks[None], first.agents[None]
    costs = np.array([_cost(problem, first)])
    for _ in range(generations):
        parents = rng.integers(len(orders), size=len(mutate) * mutations)
        new_orders, new_agents = orders[parents], agents[parents]
        for k in range(mutations):
            for way, change in enumerate(mutate):
                change(problem, new_orders[way * mutations + k], new_agents[way * mutations + k], rng)
        _, _, makespans, feasible = time_batch(
            new_orders, new_agents, problem.durations, problem.lags, problem.near, problem.deadlines
        )
        new_costs = np.where(feasible, makespans, makespans + _penalty(problem))
        orders, agents = np.concatenate([orders, new_orders]), np.concatenate([agents, new_agents])
        costs = np.concatenate([costs, new_costs])
        best = np.argsort(costs, kind="stable")[:baselines]
        orders, agents, costs = orders[best], agents[best], costs[best]
    best_plan = timed(problem, orders[0], agents[0])
    if not best_plan.feasible:
        return first  # the mutants may not even be consistent, the first order is
    by_start = np.argsort(best_plan.starts[best_plan.tasks], kind="stable")
    return timed(problem, best_plan.tasks[by_start], best_plan.agents[by_start])


def reallocate(problem: Round, order: np.ndarray, agents: np.ndarray, rng: np.random.Generator) -> None:
    """Give a task, drawn at random, to an eligible agent drawn at random; agents int64 (N,) in dispatch order."""
    place = rng.integers(len(order))
    agents[place] = rng.choice(np.flatnonzero(problem.eligible[order[place]]))


def swap_order(problem: Round, order: np.ndarray, agents: np.ndarray, rng: np.random.Generator) -> None:
    """Let two pairs, drawn at random, change places in the dispatch order, int64 (N,)."""
    a, b = rng.integers(len(order), size=2)
    order[[a, b]], agents[[a, b]] = order[[b, a]], agents[[b, a]]


def _cost(problem: Round, plan: Plan) -> int:
    return plan.makespan + (0 if plan.feasible else _penalty(problem))


def _penalty(problem: Round) -> int:
    """More than any feasible makespan."""
    return int(np.maximum(problem.durations, 0).sum() + np.maximum(problem.lags, 0).sum() + 1)

"""A running round of the simulator as the problem that a planner is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from marl_sched.agents.murse.problem import Plan, Round
from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.envs.murse.views import believes
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator


def as_murse(simulator: TurnSimulator) -> MurseSimulator:
    """The simulator as one of MuRSE; InvalidOptionError for any other."""
    if not isinstance(simulator, MurseSimulator):
        raise InvalidOptionError(f"scheduler of murse: expected a simulator of murse, got {type(simulator).__name__}")
    return simulator


def estimated_round(simulator: MurseSimulator, env_index: int, margin: float = 0.0) -> Round:
    """The whole of a row's present round on the durations that the team counts on.

    `margin` standard deviations of each duration are added to them, rounded to whole units.
    """
    instance = simulator.instances[env_index]
    pairs = simulator.state.pairs[env_index, : instance.n_tasks, : instance.n_agents]
    planned = pairs["planned"] + np.rint(margin * pairs["spread"]).astype(np.int64)
    return Round.of(instance, np.where(instance.eligible, planned, INELIGIBLE))


def remaining_round(simulator: MurseSimulator, env_index: int, margin: float = 0.0) -> Round:
    """What is left of a row's round: committed tasks with their believed times, agents when they are believed free.

    Nobody is free before now. A committed task has no deadline any more: nothing can be done about it. `margin` is
    added to the durations of open tasks, as in `estimated_round`.
    """
    whole, state = estimated_round(simulator, env_index, margin), simulator.state
    n, clock = whole.n_tasks, int(state.rows["clock"][env_index])
    agents = state.tasks["agent"][env_index, :n].copy()
    taken = np.flatnonzero(agents != NOBODY)
    start, finish = np.zeros((2, simulator.max_actions), np.int64)
    heard = np.ones(simulator.max_agents, np.bool_)
    viewer = int(simulator.acting[env_index])
    believes(state, simulator.rules, env_index, viewer, heard, state.tasks["agent"][env_index] != NOBODY, start, finish)
    durations, ready = whole.durations.copy(), np.full(whole.n_agents, clock)
    fixed, deadlines = np.full(n, -1), whole.deadlines.copy()
    durations[taken, agents[taken]] = (finish - start)[taken]
    fixed[taken], deadlines[taken] = start[taken], NO_DEADLINE
    np.maximum.at(ready, agents[taken], finish[taken])
    return replace(whole, durations=durations, deadlines=deadlines, fixed=fixed, agents=agents, ready=ready)


def as_expected(problem: Round, plan: Plan) -> bool:
    """Whether every task that is committed to in `problem` ends when the plan has it end."""
    taken = np.flatnonzero(problem.fixed >= 0)
    return np.array_equal(problem.fixed[taken] + problem.durations[taken, problem.agents[taken]], plan.finishes[taken])

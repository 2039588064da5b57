"""What every choice costs if the team goes on by a rule: the roll-out algorithm as a scheduler and as a teacher.

For each legal choice of the acting agent the rest of the round is completed by the latest-start rule, once for each
of CHARGES (marl_sched.envs.murse.rollout); the cheapest completion counts (Bertsekas, Tsitsiklis and Wu 1997).
It knows the whole problem on the durations that the team counts on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np

from marl_sched.agents.base import CostScheduler
from marl_sched.agents.local_rule import LocalRule
from marl_sched.agents.murse.lst import MARGIN, require_margin
from marl_sched.agents.murse.snapshot import as_murse
from marl_sched.envs.murse.dynamics import IDLE_AFTER_CONFLICT
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.lookahead import (
    new_outlook,
    next_event,
    problem_of,
    rule_target,
    without_padding,
    work_out,
)
from marl_sched.envs.murse.rollout import UNREACHABLE, Problem, Progress, copy_progress, dispatch, roll_out
from marl_sched.envs.murse.rules import MAKESPAN, Rules
from marl_sched.envs.murse.state import NOBODY, State
from marl_sched.envs.murse.views import EVERYWHERE, Sight, new_sight, survey
from marl_sched.kernels import kernel
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator

if TYPE_CHECKING:
    from marl_sched.domain_parts import LocalState
    from marl_sched.envs.murse.local_state import MurseLocalState

CHARGES = np.array([0.0, 2.0])
LATE_CHARGE = 2.0  # of a unit of lateness, in units of makespan
INFEASIBLE_CHARGE = 0.5  # of any lateness at all, as a share of the makespan
WAIT_CHARGE = 0.005  # of waiting, as a share of the cost: it is chosen only where it is worth something
COMPACT_CHARGE = 0.05  # of the mean finish of tasks: what tells schedules of the same makespan apart


@kernel
def cost_of(problem: Problem, done: Progress, objective: int) -> float:
    """What a completed round costs: its objective, its lateness, and a little for every finish."""
    n, last, late, total, weighted = len(done.open), 0, 0, 0.0, 0.0
    for task in range(n):
        finish = done.finish[task]
        last = max(last, finish)
        total += finish
        weighted += problem.weights[task] * finish
        if problem.deadlines[task] != NO_DEADLINE:
            late += max(finish - problem.deadlines[task], 0)
    base = float(last)
    if objective != MAKESPAN:
        base = weighted / max(problem.weights.sum(), 1e-9)
    charge = LATE_CHARGE * late + (INFEASIBLE_CHARGE * last if late > 0 else 0.0)
    return base + charge + COMPACT_CHARGE * total / n


@kernel
def waits_until(state: State, b: int, viewer: int, sight: Sight) -> int:
    """When the viewer decides again if it waits; UNREACHABLE: never. Others that are free now are taken to commit."""
    for agent in range(state.rows[b].n_agents):
        if agent != viewer and state.agents[b, agent].free_at <= state.rows[b].clock:
            return state.rows[b].clock + 1
    return next_event(state, b, sight)


@kernel
def costs_of_choices(state: State, rules: Rules, margin: float, legal: np.ndarray, costs: np.ndarray) -> None:
    """Write float64 (B, targets), in time units; inf where `legal`, int8 (B, targets), forbids it or nothing follows.

    `margin` is that of lookahead.take_stock. A legal task that is taken in truth costs its agent IDLE_AFTER_CONFLICT.
    """
    sight, outlook, trial = new_sight(state), new_outlook(state), new_outlook(state)
    for b in range(len(costs)):
        costs[b] = np.inf
        viewer = state.rows[b].acting
        if viewer == NOBODY:
            continue
        survey(state, rules, b, viewer, EVERYWHERE, EVERYWHERE, sight)
        work_out(state, b, sight, margin, outlook)
        n, m, clock = state.rows[b].n_tasks, state.rows[b].n_agents, state.rows[b].clock
        problem, now = problem_of(state, b, outlook), without_padding(outlook.now, n, m)
        then, wakes = without_padding(trial.now, n, m), waits_until(state, b, viewer, sight)
        for target in range(n + 1):
            if legal[b, target] == 0 or (target == 0 and wakes >= UNREACHABLE):
                continue
            for charge in CHARGES:
                copy_progress(now, then)
                if target == 0:
                    then.ready[viewer] = wakes
                elif now.open[target - 1]:
                    dispatch(problem, then, target - 1, viewer, trial.choice.stale)
                else:
                    then.ready[viewer] = clock + IDLE_AFTER_CONFLICT
                roll_out(
                    problem, then, outlook.latest[:n], outlook.prices[:m], outlook.cheapest[:n], charge, trial.choice,
                    trial.plan,
                )  # fmt: skip
                costs[b, target] = min(costs[b, target], cost_of(problem, then, rules.objective))
        costs[b, 0] *= 1.0 + WAIT_CHARGE


class LatestStartRollout(CostScheduler):
    """Takes the choice of least cost, ties to the lower index. Raises InvalidOptionError for a negative margin.

    `margin` standard deviations of each duration are added to what the team expects.
    """

    name = "lst-rollout"
    privileged_info = PrivilegedInfo.DURATIONS | PrivilegedInfo.WAITS | PrivilegedInfo.DEADLINES | PrivilegedInfo.PLACES

    def __init__(self, margin: float = 0.0) -> None:
        self._margin = require_margin(self.name, margin)

    def costs(self, simulator: TurnSimulator, legal: np.ndarray) -> np.ndarray:
        """See costs_of_choices."""
        murse = as_murse(simulator)
        costs = np.full(legal.shape, np.inf)
        costs_of_choices(murse.state, murse.rules, self._margin, legal, costs)
        return costs

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Targets int64 (B,)."""
        return self.costs(simulator, simulator.legal()).argmin(axis=1)


class RobustRollout(LatestStartRollout):
    """`lst-rollout` with the margin of `lst-robust`."""

    name = "lst-robust-rollout"

    def __init__(self, margin: float = MARGIN) -> None:
        super().__init__(margin)


@kernel
def choices_by_rule(
    state: State, rules: Rules, sensing: float, comm: float, margin: float, targets: np.ndarray
) -> None:
    """Write what the latest-start rule has the acting agents do, int64 (B,), on what they see; 0 where nobody acts."""
    sight, outlook = new_sight(state), new_outlook(state)
    for b in range(len(targets)):
        viewer, targets[b] = state.rows[b].acting, 0
        if viewer != NOBODY:
            survey(state, rules, b, viewer, sensing, comm, sight)
            count = work_out(state, b, sight, margin, outlook)
            targets[b] = rule_target(state, b, viewer, count, outlook)


@kernel
def choice_on_sight(state: State, viewer: int, sight: Sight, margin: float, targets: np.ndarray) -> None:
    """Write what the rule has an agent do, int64 (1,), that was told `sight` of the only row."""
    outlook = new_outlook(state)
    for b in range(len(targets)):  # not a literal 0, for which everything would be compiled again
        count = work_out(state, b, sight, margin, outlook)
        targets[b] = rule_target(state, b, viewer, count, outlook)


class LocalLst(LocalRule):
    """The latest-start rule run by every agent by itself, whenever it decides, on what it sees under its view.

    Raises InvalidOptionError for a negative margin, of which so many standard deviations are added to durations.
    """

    name = "lst-local"

    def __init__(self, margin: float = 0.0) -> None:
        self._margin = require_margin(self.name, margin)

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Targets int64 (B,)."""
        murse, targets = as_murse(simulator), np.zeros(simulator.batch, np.int64)
        choices_by_rule(murse.state, murse.rules, *murse.view.limits, self._margin, targets)
        return targets

    def choose_locally(self, known: LocalState) -> int:
        """One agent's target on what it was told."""
        told, targets = cast("MurseLocalState", known), np.zeros(1, np.int64)
        choice_on_sight(told.state, told.agent, told.sight, self._margin, targets)
        return int(targets[0])


class RobustLocalLst(LocalLst):
    """`lst-local` with the margin of `lst-robust`."""

    name = "lst-robust-local"

    def __init__(self, margin: float = MARGIN) -> None:
        super().__init__(margin)

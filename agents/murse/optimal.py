"""The exact solver as a scheduler: once per round, or again whenever things go otherwise than expected."""

from __future__ import annotations

from typing import Any, TypedDict

import numpy as np

from marl_sched.agents.murse.best_rule import best_rule_plan
from marl_sched.agents.murse.exact import WORK_LIMIT, Solution, require_limits, solve
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.problem import Plan, Round, timed
from marl_sched.agents.murse.snapshot import as_expected, estimated_round, remaining_round
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator

_ROLLING_WORK_LIMIT = 2.0  # deterministic seconds per new plan
SOLVER_MEASURES = ("bound", "optimal", "timed_out", "without_plan", "solver_seconds")


class Limits(TypedDict):
    """What ends a solver's search: seconds, units of deterministic work, and how many threads share it."""

    time_limit: float | None
    work_limit: float | None
    threads: int


class ExactScheduler(PlanningScheduler):
    """Solves every round on estimated durations with CP-SAT, from the best rule's plan on, and follows the solution.

    Without limits a run gets WORK_LIMIT deterministic seconds; `time_limit` is in wall seconds. A round for which
    neither the solver nor a rule has a feasible plan is played by the best rule's plan, and counted as
    `without_plan`. The per-round measures of SOLVER_MEASURES say what the solver was worth.

    Attributes:
        solutions: (row, round) -> what the solver found last, of the running episodes.
    """

    name = "exact"
    default_work_limit = WORK_LIMIT

    def __init__(self, time_limit: float | None = None, work_limit: float | None = None, threads: int = 1) -> None:
        super().__init__()
        require_limits(self.name, work_limit, time_limit, threads)
        if time_limit is None and work_limit is None:
            work_limit = self.default_work_limit
        self._limits = Limits(time_limit=time_limit, work_limit=work_limit, threads=threads)
        self.solutions: dict[tuple[int, int], Solution] = {}
        self._measures = {name: np.zeros((0, 0)) for name in SOLVER_MEASURES}

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Forget the plans, solutions and measures of `envs`, bool (B,)."""
        super().start(simulator, envs)
        self.solutions = {
            key: found for key, found in self.solutions.items() if key[0] < len(envs) and not envs[key[0]]
        }
        shape = (simulator.batch, getattr(simulator, "horizon", 1))
        for name, values in self._measures.items():
            if values.shape != shape:
                self._measures[name] = np.full(shape, np.nan)
            self._measures[name][envs] = np.nan

    def per_round(self) -> dict[str, np.ndarray]:
        """SOLVER_MEASURES, float64 (B, rounds), NaN where no round was solved.

        The bound is that of the round's first run; the others are sums over the round's runs, `optimal` too.
        """
        return {name: values.copy() for name, values in self._measures.items()}

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The solution of the round on estimates, everything as early as its order allows."""
        problem = self.whole(simulator, env_index)
        plan = self._solved(simulator, env_index, problem)
        return timed(problem, plan.tasks, plan.agents)

    def whole(self, simulator: MurseSimulator, env_index: int) -> Round:
        """The round as the solver is given it at its beginning."""
        return estimated_round(simulator, env_index)

    def _solved(self, simulator: MurseSimulator, env_index: int, problem: Round) -> Plan:
        first = best_rule_plan(problem, simulator.objective)
        solution = solve(problem, objective=simulator.objective, start=first, **self._limits)
        now = int(simulator.state.rows["round"][env_index])
        self.solutions[env_index, now] = solution
        instance = simulator.instances[env_index]
        certain = instance.durations == "deterministic" or instance.n_humans == 0
        new = {
            "bound": solution.bound if certain else np.nan,  # a bound on estimates proves nothing of what happens
            "optimal": solution.status == "optimal",
            "timed_out": solution.timed_out,
            "without_plan": solution.plan is None,
            "solver_seconds": solution.seconds,
        }
        again = not np.isnan(self._measures["optimal"][env_index, now])
        for name, value in new.items():
            if not again:
                self._measures[name][env_index, now] = value
            elif name != "bound":
                self._measures[name][env_index, now] += value
        return first if solution.plan is None else solution.plan


class RollingScheduler(ExactScheduler):
    """Plans again whenever an agent becomes free and something did not end when the plan had it end.

    What is committed to stays, running tasks end at their expected times, the rest is solved anew, with `margin`
    standard deviations added to every open task's duration. While everything goes as planned, the plan is kept.
    """

    name = "exact-rolling"
    default_work_limit = _ROLLING_WORK_LIMIT

    def __init__(
        self,
        time_limit: float | None = None,
        work_limit: float | None = None,
        threads: int = 1,
        margin: float = 0.0,
    ) -> None:
        super().__init__(time_limit, work_limit, threads)
        if not 0.0 <= margin < np.inf:
            raise InvalidOptionError(f"{self.name}: margin: expected a number >= 0, got {margin}")
        self._margin = margin

    def whole(self, simulator: MurseSimulator, env_index: int) -> Round:
        """The round with the margin on every duration."""
        return estimated_round(simulator, env_index, self._margin)

    def revise(self, simulator: MurseSimulator, env_index: int, plan: Plan) -> Plan:
        """A plan for what is left of the round."""
        if simulator.mode == "plan":
            return plan
        problem = remaining_round(simulator, env_index, self._margin)
        return plan if as_expected(problem, plan) else self._solved(simulator, env_index, problem)


def is_feasible(instance: MurseInstance, time_limit: float | None = None) -> bool:
    """Whether a rule or the solver finds a feasible plan of the first round, humans at their means.

    Without a `time_limit` in seconds the solver works for WORK_LIMIT; False if a limit came first.
    """
    problem = Round.of(instance)
    first = best_rule_plan(problem)
    return first.feasible or solve(problem, time_limit=time_limit).plan is not None


def solver_bound(instance: MurseInstance, objective: str, time_limit: float | None = None) -> dict[str, Any]:
    """What CP-SAT proves of the first round: `bound`, `status` and `seconds`.

    Where humans' durations are drawn nothing can be proved of what happens: the bound is None, the status "uncertain
    durations". Without a `time_limit` in seconds the solver works for WORK_LIMIT.
    """
    if instance.durations != "deterministic" and instance.n_humans:
        return {"bound": None, "status": "uncertain durations", "seconds": 0.0}
    problem = Round.of(instance)
    found = solve(problem, objective=objective, time_limit=time_limit, start=best_rule_plan(problem, objective))
    bound = None if np.isnan(found.bound) else found.bound
    return {"bound": bound, "status": found.status, "seconds": found.seconds}

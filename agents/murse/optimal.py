"""The exact solver as a scheduler: once per round, or again whenever things go otherwise than expected."""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.exact import Solution, solve
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.list_schedule import edf_priority, edf_schedule, list_schedule
from marl_sched.agents.murse.problem import Plan, Round, timed
from marl_sched.agents.murse.snapshot import estimated_round, remaining_round
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator

_TIME_LIMIT = 10.0  # seconds per round
_ROLLING_TIME_LIMIT = 2.0  # seconds per new plan


class ExactScheduler(PlanningScheduler):
    """Solves every round on estimated durations with CP-SAT and follows the solution.

    A round for which the solver finds no feasible plan, because there is none or because `time_limit` seconds were
    not enough, is played by EDF; `solutions` says which.

    Attributes:
        solutions: (row, round) -> what the solver found, of the running episodes.
    """

    name = "exact"

    def __init__(self, time_limit: float = _TIME_LIMIT) -> None:
        super().__init__()
        if not time_limit > 0:
            raise InvalidOptionError(f"{self.name}: time_limit: expected seconds > 0, got {time_limit}")
        self._time_limit = time_limit
        self.solutions: dict[tuple[int, int], Solution] = {}

    def start(self, simulator: TurnSimulator, rows: np.ndarray) -> None:
        """Forget the rows' plans and solutions."""
        super().start(simulator, rows)
        self.solutions = {
            key: found for key, found in self.solutions.items() if key[0] < len(rows) and not rows[key[0]]
        }

    def plan(self, simulator: MurseSimulator, row: int) -> Plan:
        """The solution of the round on estimates, everything as early as its order allows."""
        problem = estimated_round(simulator, row)
        solution = self._solve(simulator, problem)
        self.solutions[row, int(simulator.state.rows["round"][row])] = solution
        if solution.plan is None:
            return edf_schedule(problem)
        return timed(problem, solution.plan.tasks, solution.plan.agents)

    def _solve(self, simulator: MurseSimulator, problem: Round) -> Solution:
        return solve(problem, objective=simulator.objective, time_limit=self._time_limit)


class RollingScheduler(ExactScheduler):
    """Plans again whenever an agent becomes free and something did not end when the plan had it end.

    What is committed to stays, running tasks end at their expected times, the rest is solved anew. While
    everything goes as planned, an optimal plan remains one and is kept. Where no feasible plan is found, what is
    left is completed by EDF.
    """

    name = "exact-rolling"

    def __init__(self, time_limit: float = _ROLLING_TIME_LIMIT) -> None:
        super().__init__(time_limit)

    def revise(self, simulator: MurseSimulator, row: int, plan: Plan) -> Plan:
        """A plan for what is left of the round."""
        problem = remaining_round(simulator, row)
        taken = problem.fixed >= 0
        finishes = problem.fixed + problem.durations[np.arange(problem.n_tasks), np.maximum(problem.agents, 0)]
        if np.array_equal(finishes[taken], plan.finishes[taken]):
            return plan
        solution = self._solve(simulator, problem)
        if solution.plan is None:
            return list_schedule(problem, edf_priority(problem.deadlines))
        return solution.plan


def is_feasible(instance: MurseInstance, time_limit: float = _TIME_LIMIT) -> bool:
    """Whether the solver proves the first round feasible, humans at their means; False if the time was up."""
    return solve(Round.of(instance), time_limit=time_limit).plan is not None

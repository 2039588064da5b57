"""The schedulers `lst`, `lst-robust`, `lst-backward` and `lst-search`: least latest start first, see `latest_start`."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from marl_sched.agents.murse import latest_start as kernels
from marl_sched.agents.murse.backward import backward_keys
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.problem import Plan, Round
from marl_sched.agents.murse.snapshot import as_expected, estimated_round, remaining_round
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.timetable import deadlines_hold
from marl_sched.errors import InvalidOptionError

MARGIN = 0.5  # of lst-robust, in standard deviations of a duration
EVALUATIONS = 512
_BLOCK = 16  # evaluations between two looks at the clock


def latest_start_keys(problem: Round) -> np.ndarray:
    """The rule's keys of a round, float64 (N,)."""
    horizon = kernels.common_horizon(problem.durations)
    return np.asarray(kernels.latest_starts(problem.durations, problem.lags, problem.deadlines, horizon))


def keyed_plan(problem: Round, keys: np.ndarray) -> Plan:
    """The schedule that keys, float64 (N,), generate behind what is committed to."""
    return _Partial.of(problem).plan(problem, keys)


def lst_plan(problem: Round) -> Plan:
    """The rule's schedule, in one pass."""
    return keyed_plan(problem, latest_start_keys(problem))


def search_plan(
    problem: Round,
    *,
    evaluations: int | None = EVALUATIONS,
    seconds: float | None = None,
    objective: str = "makespan",
    key: int = 0,
    keys: np.ndarray | None = None,
) -> Plan:
    """The best schedule of a hill climb on keys that starts at the rule's, or at `keys` float64 (N,).

    It ends after `evaluations` schedules, the first one included, or when `seconds` of wall time are over, whichever
    is earlier; only the former gives the same plan every time. Never worse than the start: the sum of lateness
    counts first, then the objective. `key` names its random numbers. Raises InvalidOptionError without a budget.
    """
    require_budget("lst-search", evaluations, seconds)
    ends = time.perf_counter() + (np.inf if seconds is None else seconds)
    partial, code = _Partial.of(problem), kernels.WEIGHTED if objective == "weighted" else kernels.MAKESPAN
    best_keys = latest_start_keys(problem) if keys is None else np.array(keys, np.float64)
    first = partial.plan(problem, best_keys)
    goal = (problem.deadlines, problem.weights, code)
    best = kernels.cost(first.finishes, *goal)
    waiting, limit, done = kernels.successors(problem.lags), np.inf if evaluations is None else evaluations, 1
    while done < limit and time.perf_counter() < ends:
        last = int(min(limit, done + (_BLOCK if seconds is not None else limit)))
        best = kernels.climb(
            problem.durations, waiting, problem.near, *goal, problem.ready, *partial.arrays(), best_keys, best,
            np.uint64(key), done, last,
        )  # fmt: skip
        done = last
    return partial.plan(problem, best_keys)


def require_budget(name: str, evaluations: int | None, seconds: float | None) -> None:
    """Raise InvalidOptionError unless a search has a positive budget of evaluations or seconds."""
    if evaluations is None and seconds is None:
        raise InvalidOptionError(f"{name}: expected a budget: evaluations or seconds")
    if evaluations is not None and evaluations < 1:
        raise InvalidOptionError(f"{name}: evaluations: expected an integer >= 1, got {evaluations}")
    if seconds is not None and not seconds > 0:
        raise InvalidOptionError(f"{name}: seconds: expected a number > 0, got {seconds}")


def require_margin(name: str, margin: float) -> float:
    """A margin on durations as it is; InvalidOptionError for a negative or infinite one."""
    if not 0.0 <= margin < np.inf:
        raise InvalidOptionError(f"{name}: margin: expected a number >= 0, got {margin}")
    return margin


@dataclass(frozen=True, eq=False)
class _Partial:
    """What is committed to in a round, as `complete` takes it: the first `count` of `order`, int64 (N,) each."""

    order: np.ndarray
    count: int
    doers: np.ndarray
    start: np.ndarray
    finish: np.ndarray

    @classmethod
    def of(cls, problem: Round) -> _Partial:
        committed = np.flatnonzero(problem.fixed >= 0)
        committed = committed[np.argsort(problem.fixed[committed], kind="stable")]
        order, finish = np.zeros(problem.n_tasks, np.int64), np.zeros(problem.n_tasks, np.int64)
        order[: len(committed)] = committed
        start, doers = np.maximum(problem.fixed, 0), problem.agents.copy()
        finish[committed] = start[committed] + problem.durations[committed, doers[committed]]
        return cls(order, len(committed), doers, start, finish)

    def arrays(self) -> tuple[np.ndarray, int, np.ndarray, np.ndarray, np.ndarray]:
        """Copies to be completed."""
        return self.order.copy(), self.count, self.doers.copy(), self.start.copy(), self.finish.copy()

    def plan(self, problem: Round, keys: np.ndarray) -> Plan:
        """The plan that keys generate."""
        order, count, doers, start, finish = self.arrays()
        waiting = kernels.successors(problem.lags)
        count = kernels.complete(
            problem.durations, waiting, problem.near, keys, problem.ready.copy(), order, count, doers, start, finish
        )
        tasks = order[:count]
        return Plan(
            tasks=tasks,
            agents=doers[tasks],
            starts=start,
            finishes=finish,
            makespan=int(finish.max()),
            feasible=count == problem.n_tasks and bool(deadlines_hold(tasks, finish, problem.deadlines)),
        )


class LeastLatestStart(PlanningScheduler):
    """Plans a round by the rule and, in `online` mode, anew whenever a task did not end when the plan had it end.

    What is committed to stays, running tasks end at their expected times. `margin` standard deviations of each
    duration are added to what the team expects.
    """

    name = "lst"
    plans_on_estimates = True

    def __init__(self, margin: float = 0.0) -> None:
        super().__init__()
        self.margin = require_margin(self.name, margin)

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The rule's schedule of the whole round."""
        return self.scheduled(simulator, env_index, estimated_round(simulator, env_index, self.margin))

    def revise(self, simulator: MurseSimulator, env_index: int, plan: Plan) -> Plan:
        """The rule's schedule of what is left, where that differs."""
        if simulator.mode == "plan":
            return plan
        problem = remaining_round(simulator, env_index, self.margin)
        return plan if as_expected(problem, plan) else self.scheduled(simulator, env_index, problem)

    def scheduled(self, simulator: MurseSimulator, env_index: int, problem: Round) -> Plan:
        """A plan for what is open in `problem`."""
        return lst_plan(problem)


class RobustLst(LeastLatestStart):
    """`lst` with a margin on all durations."""

    name = "lst-robust"

    def __init__(self, margin: float = MARGIN) -> None:
        super().__init__(margin)


class BackwardLst(LeastLatestStart):
    """Latest starts that count agents and places (`backward`), generated forwards as `lst` generates its own."""

    name = "lst-backward"

    def scheduled(self, simulator: MurseSimulator, env_index: int, problem: Round) -> Plan:
        """The schedule by these keys."""
        return keyed_plan(problem, backward_keys(problem))


class LstSearch(LeastLatestStart):
    """The best schedule of a hill climb on the rule's keys within a budget, see `search_plan`."""

    name = "lst-search"
    plans_on_estimates = False  # its random numbers are those of the episode, whose key no agent is told

    def __init__(
        self, evaluations: int | None = EVALUATIONS, seconds: float | None = None, margin: float = 0.0
    ) -> None:
        super().__init__(margin)
        require_budget(self.name, evaluations, seconds)
        self._budget = evaluations, seconds

    def scheduled(self, simulator: MurseSimulator, env_index: int, problem: Round) -> Plan:
        """The best plan found; its random numbers are those of the row's episode and round."""
        evaluations, seconds = self._budget
        rows = simulator.state.rows
        key = int(rows["episode"][env_index]) ^ int(rows["round"][env_index])
        return search_plan(problem, evaluations=evaluations, seconds=seconds, objective=simulator.objective, key=key)

"""The exact scheduler: OR-Tools CP-SAT over optional intervals (the problem of equations 3.1-3.9 and 4.1).

Each task has one start and, for every eligible agent, an optional interval; exactly one is taken. An agent's
intervals do not overlap, nor do those of a pair that is near; waits and deadlines bound starts and finishes. The
dissertation linearises the same problem for a MILP solver; intervals need no big-M constants.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.agents.murse.problem import Plan, Round, plan_cost, timed
from marl_sched.envs.murse.instance import NO_DEADLINE, waiting_order
from marl_sched.envs.murse.timetable import longest_round
from marl_sched.errors import InvalidOptionError, MarlSchedError, require

if TYPE_CHECKING:
    from ortools.sat.python import cp_model

OBJECTIVES = ("makespan", "weighted")
_STOPPING_SECONDS = 0.01  # between two requests to stop
_WEIGHT_UNIT = 1000  # CP-SAT counts in integers; weights are rounded to thousandths


WORK_LIMIT = 10.0
"""Deterministic seconds of a run: CP-SAT's count of its work, about a second of one core each, whatever else runs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """What the solver found, and under which limits.

    Attributes:
        plan: the best schedule, None if none was found.
        status: "optimal", "feasible", "infeasible" (proved) or "unknown" (a limit came first).
        objective: of the plan; nan without one.
        bound: no schedule is better than this; nan if infeasible.
        improved: whether the plan is better than the one that the solver started from.
        seconds: wall time spent.
        work: deterministic seconds spent.
        work_limit, time_limit: limits of the two, None for no limit.
        threads: number of threads.
    """

    plan: Plan | None
    status: str
    objective: float
    bound: float
    improved: bool
    seconds: float
    work: float
    work_limit: float | None
    time_limit: float | None
    threads: int

    @property
    def gap(self) -> float:
        """(objective - bound) / objective, 0 for a proved optimum; nan without a plan."""
        return (self.objective - self.bound) / self.objective if self.objective else 0.0

    @property
    def timed_out(self) -> bool:
        """Whether a limit ended the run before it had proved anything."""
        return self.status in ("feasible", "unknown")


def solve(
    problem: Round,
    *,
    objective: str = "makespan",
    work_limit: float | None = None,
    time_limit: float | None = None,
    threads: int = 1,
    seed: int = 0,
    start: Plan | None = None,
) -> Solution:
    """Minimise the makespan or the weighted completion time within the limits, whichever comes first.

    Without any limit WORK_LIMIT holds. With one thread and without a `time_limit`, in wall seconds, the outcome is the
    same every time, under load as well. `start` is a
    plan of the same problem: where it is feasible the solver begins there, and what it returns is never worse.
    Ctrl-C ends the run with KeyboardInterrupt. Raises UnknownNameError or InvalidOptionError for options outside
    their domain, MarlSchedError without OR-Tools.
    """
    require("objective of murse", objective, OBJECTIVES)
    require_limits("exact", work_limit, time_limit, threads)
    if work_limit is None and time_limit is None:
        work_limit = WORK_LIMIT
    cp = ortools()
    start = start if start is not None and start.feasible else None
    model = _Model(cp, problem, start if objective == "makespan" else None)
    model.minimise(objective)
    if start is not None:
        model.hint(start)
    solver = cp.CpSolver()
    solver.parameters.num_workers = threads
    solver.parameters.random_seed = seed
    if work_limit is not None:
        solver.parameters.max_deterministic_time = work_limit
    if time_limit is not None:
        solver.parameters.max_time_in_seconds = time_limit
    status = _run(solver, model.model)
    plan = model.plan(solver) if status in (cp.OPTIMAL, cp.FEASIBLE) else None
    if plan is not None and not problem.ready.any() and (problem.fixed < 0).all():
        plan = timed(problem, plan.tasks, plan.agents)  # a run that a limit ended may leave gaps
    better = plan is not None and (
        start is None or plan_cost(problem, plan, objective) < plan_cost(problem, start, objective)
    )
    plan = plan if better else start
    unit = _WEIGHT_UNIT if objective == "weighted" else 1
    words = {cp.OPTIMAL: "optimal", cp.INFEASIBLE: "infeasible"}
    return Solution(
        plan=plan,
        status=words.get(status, "unknown" if plan is None else "feasible"),
        objective=np.nan if plan is None else plan_cost(problem, plan, objective)[1],
        bound=np.nan if status == cp.INFEASIBLE else float(solver.best_objective_bound) / unit,
        improved=better,
        seconds=float(solver.wall_time),
        work=float(solver.deterministic_time),
        work_limit=work_limit,
        time_limit=time_limit,
        threads=threads,
    )


def require_limits(name: str, work_limit: float | None, time_limit: float | None, threads: int) -> None:
    """Raise InvalidOptionError unless the limits that are given are positive, and threads at least one."""
    for option, limit in (("work_limit", work_limit), ("time_limit", time_limit)):
        if limit is not None and not limit > 0:
            raise InvalidOptionError(f"{name}: {option}: expected seconds > 0, got {limit}")
    if threads < 1:
        raise InvalidOptionError(f"{name}: threads: expected an integer >= 1, got {threads}")


def _run(solver: Any, model: Any) -> Any:
    """The status of a run in a thread of its own: the main thread stays free to take Ctrl-C, and then ends the run."""
    solver.parameters.catch_sigint_signal = False
    outcome: Future[Any] = Future()

    def solve_model() -> None:
        try:
            outcome.set_result(solver.solve(model))
        except BaseException as error:  # raised again where the outcome is read
            outcome.set_exception(error)

    running = threading.Thread(target=solve_model, name="cp-sat")
    try:
        running.start()
        return outcome.result()
    except BaseException:
        while running.is_alive():  # a run that has not begun yet cannot be stopped
            solver.stop_search()
            time.sleep(_STOPPING_SECONDS)
        raise


class _Model:
    """The constraint model of one round, and the way back from its solution to a plan."""

    def __init__(self, cp: Any, problem: Round, within: Plan | None) -> None:
        self.problem = problem
        self.model: cp_model.CpModel = cp.CpModel()
        release = int(max(problem.ready.max(), problem.fixed.max(), 0))
        longest = release + int(longest_round(problem.durations, problem.lags))
        self.horizon = longest if within is None else within.makespan
        self.starts = [self._start(i) for i in range(problem.n_tasks)]
        self.ends: list[Any] = []
        self.taken: dict[tuple[int, int], Any] = {}
        self._tasks()
        self._constraints()

    def _start(self, i: int) -> Any:
        fixed = int(self.problem.fixed[i])
        low, high = (fixed, fixed) if fixed >= 0 else (0, self.horizon)
        return self.model.new_int_var(low, high, f"start {i + 1}")

    def _tasks(self) -> None:
        """Optional intervals of every task, one of which is taken, and no overlap of an agent's."""
        problem, model = self.problem, self.model
        of_agent: list[list[Any]] = [[] for _ in range(problem.n_agents)]
        for i in range(problem.n_tasks):
            end = model.new_int_var(0, self.horizon, f"end {i + 1}")
            able = [int(problem.agents[i])] if problem.fixed[i] >= 0 else np.flatnonzero(problem.eligible[i]).tolist()
            for agent in able:
                taken = model.new_bool_var(f"{i + 1} by {agent}")
                duration = int(problem.durations[i, agent])
                interval = model.new_optional_interval_var(self.starts[i], duration, end, taken, f"{i + 1} at {agent}")
                of_agent[agent].append(interval)
                self.taken[i, agent] = taken
                if problem.fixed[i] < 0 and problem.ready[agent] > 0:
                    model.add(self.starts[i] >= int(problem.ready[agent])).only_enforce_if(taken)
            model.add_exactly_one(self.taken[i, agent] for agent in able)
            self.ends.append(end)
        for intervals in of_agent:
            model.add_no_overlap(intervals)

    def _constraints(self) -> None:
        """Waits, deadlines and separation in space."""
        problem, model = self.problem, self.model
        for i, j in np.argwhere(problem.lags >= 0):
            model.add(self.starts[i] >= self.ends[j] + int(problem.lags[i, j]))
        for i in np.flatnonzero(problem.deadlines != NO_DEADLINE):
            model.add(self.ends[i] <= int(problem.deadlines[i]))
        spans = {
            i: model.new_interval_var(self.starts[i], self._length(i), self.ends[i], f"span {i + 1}")
            for i in np.flatnonzero(problem.near.any(axis=1)).tolist()
        }
        for i, j in np.argwhere(np.triu(problem.near)).tolist():
            if (problem.fixed[i] >= 0) == (problem.fixed[j] >= 0):
                model.add_no_overlap([spans[i], spans[j]])
            else:  # what is committed to goes first
                first, second = (i, j) if problem.fixed[i] >= 0 else (j, i)
                model.add(self.starts[second] >= self.ends[first])

    def _length(self, i: int) -> Any:
        longest = int(self.problem.durations[i].max())
        length = self.model.new_int_var(0, longest, f"length {i + 1}")
        self.model.add(length == self.ends[i] - self.starts[i])
        return length

    def hint(self, plan: Plan) -> None:
        """Let the solver begin with a feasible plan."""
        for i in range(self.problem.n_tasks):
            self.model.add_hint(self.starts[i], int(plan.starts[i]))
            self.model.add_hint(self.ends[i], int(plan.finishes[i]))
        doers = dict(zip(plan.tasks.tolist(), plan.agents.tolist(), strict=True))
        for (i, agent), taken in self.taken.items():
            self.model.add_hint(taken, int(doers[i] == agent))

    def minimise(self, objective: str) -> None:
        """Set what is minimised."""
        if objective == "makespan":
            makespan = self.model.new_int_var(0, self.horizon, "makespan")
            self.model.add_max_equality(makespan, self.ends)
            for agent in range(self.problem.n_agents):
                # Implied by the intervals, but only this tells the linear relaxation how much work there is.
                load = sum(
                    int(self.problem.durations[i, a]) * taken for (i, a), taken in self.taken.items() if a == agent
                )
                self.model.add(makespan >= load)
            self.model.minimize(makespan)
        else:
            costs = np.rint(self.problem.weights * _WEIGHT_UNIT).astype(np.int64)
            self.model.minimize(sum(int(cost) * end for cost, end in zip(costs, self.ends, strict=True)))

    def plan(self, solver: Any) -> Plan:
        """The solution as an order of dispatch: by start, ties by finish, then what waits after what it waits for."""
        starts = np.array([solver.value(start) for start in self.starts], np.int64)
        finishes = np.array([solver.value(end) for end in self.ends], np.int64)
        agents = np.full(len(starts), -1, np.int64)
        for (i, agent), taken in self.taken.items():
            if solver.boolean_value(taken):
                agents[i] = agent
        waits = np.argwhere(self.problem.lags >= 0)
        rank = np.argsort(waiting_order(len(starts), np.pad(waits, ((0, 0), (0, 1)))))
        tasks = np.lexsort((rank, finishes, starts))
        return Plan(
            tasks=tasks,
            agents=agents[tasks],
            starts=starts,
            finishes=finishes,
            makespan=int(finishes.max()),
            feasible=True,
        )


def ortools() -> Any:
    """The CP-SAT module; MarlSchedError without OR-Tools."""
    try:
        from ortools.sat.python import cp_model
    except ModuleNotFoundError as error:
        raise MarlSchedError("solver: expected OR-Tools to be installed: pip install 'marl-sched[solvers]'") from error
    return cp_model

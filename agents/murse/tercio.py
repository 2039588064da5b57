"""Tercio: tasks are shared out by a mathematical program and put in order by a fast sequencer (Gombolay et al., 2018).

The program minimises the largest workload of an agent. The sequencer takes tasks in order of the latest finish that
the temporal network leaves them, as `latest_start` generates schedules. Before it, an analytical test asks whether
each agent's work can end in time: the tasks that have to be done by some time must fit between the earliest time at
which one of them can start and that time, for every such time, one window inside the next. What fails is cut off, and
the program is solved again.

Where this differs from the paper: its sequencer tests before every single dispatch whether the open tasks still
fit, and weighs several priorities; here the test is held once against an allocation and the priority is one. Its
program also balances the numbers of tasks to help the sequencer; here further allocations come from the cuts alone:
a failed test cuts off giving those tasks to that agent, a failed sequence its very allocation. It stops after a
number of allocations, not at a wanted makespan, and returns the best schedule. The program stops within 5 percent.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from marl_sched.agents.murse.exact import ortools
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.lst import keyed_plan, lst_plan
from marl_sched.agents.murse.problem import Plan, Round, plan_cost
from marl_sched.agents.murse.snapshot import estimated_round
from marl_sched.agents.murse.windows import task_windows
from marl_sched.envs.murse.instance import INELIGIBLE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError

# A workload need not be the very least, another allocation is tried anyway; deterministic seconds depend on no clock.
_PROGRAM_SECONDS = 0.02
_PROGRAM_GAP = 0.05
ALLOCATIONS = 5


class Tercio(PlanningScheduler):
    """Plans every round by `tercio` on estimated durations."""

    name = "tercio"

    def __init__(self, allocations: int = ALLOCATIONS) -> None:
        super().__init__()
        if allocations < 1:
            raise InvalidOptionError(f"{self.name}: allocations: expected an integer >= 1, got {allocations}")
        self._allocations = allocations

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The best schedule found."""
        return tercio(estimated_round(simulator, env_index), self._allocations)


def tercio(problem: Round, allocations: int) -> Plan:
    """The best schedule of the first `allocations` allocations.

    Where the network is inconsistent by itself, or no allocation comes to the sequencer, the sequencer also
    allocates: every task goes to the agent that ends it first.
    """
    windows = task_windows(problem)
    if windows is None:
        return lst_plan(problem)
    latest, best = windows[1].astype(np.float64), None
    program = _Allocation(problem)
    for _ in range(allocations):
        doers = program.solve()
        if doers is None:
            break
        overloaded = overload(problem, doers, *windows)
        if overloaded is not None:
            program.cut(*overloaded)
            continue
        plan = keyed_plan(_given(problem, doers), latest)
        if best is None or plan_cost(problem, plan, "makespan") < plan_cost(problem, best, "makespan"):
            best = plan
        program.cut(np.arange(problem.n_tasks), doers)
    return keyed_plan(problem, latest) if best is None else best


def overload(
    problem: Round, doers: np.ndarray, earliest: np.ndarray, latest: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Tasks of one agent that cannot all end in time, int64 (k,), and that agent for each; None if there are none.

    doers int64 (N,) is the allocation, earliest and latest are the tasks' windows.
    """
    for agent in range(problem.n_agents):
        own = np.flatnonzero(doers == agent)
        for latest_finish in np.unique(latest[own]):
            due = own[latest[own] <= latest_finish]
            if earliest[due].min() + problem.durations[due, agent].sum() > latest_finish:
                return due, doers[due]
    return None


def _given(problem: Round, doers: np.ndarray) -> Round:
    """The round in which only the given agent, int64 (N,), can do a task."""
    only = np.full_like(problem.durations, INELIGIBLE)
    tasks = np.arange(problem.n_tasks)
    only[tasks, doers] = problem.durations[tasks, doers]
    return replace(problem, durations=only)


class _Allocation:
    """Who does what, so that the largest workload is least."""

    def __init__(self, problem: Round) -> None:
        self._cp = ortools()
        self._model = self._cp.CpModel()
        self._taken: dict[tuple[int, int], Any] = {
            (int(i), int(a)): self._model.new_bool_var(f"{i + 1} by {a}") for i, a in np.argwhere(problem.eligible)
        }
        largest = self._model.new_int_var(0, int(np.maximum(problem.durations, 0).sum()), "largest workload")
        for i in range(problem.n_tasks):
            self._model.add_exactly_one(taken for (task, _), taken in self._taken.items() if task == i)
        for a in range(problem.n_agents):
            load = sum(int(problem.durations[i, a]) * taken for (i, doer), taken in self._taken.items() if doer == a)
            self._model.add(largest >= load)
        self._model.minimize(largest)
        self._n_tasks = problem.n_tasks

    def cut(self, tasks: np.ndarray, agents: np.ndarray) -> None:
        """Forbid that these tasks, int64 (k,), all go to these agents."""
        self._model.add_bool_or(self._taken[int(i), int(a)].negated() for i, a in zip(tasks, agents, strict=True))

    def solve(self) -> np.ndarray | None:
        """The agent of each task, int64 (N,), or None if no allocation is left."""
        solver = self._cp.CpSolver()
        solver.parameters.num_workers = 1
        solver.parameters.max_deterministic_time = _PROGRAM_SECONDS
        solver.parameters.relative_gap_limit = _PROGRAM_GAP
        solver.parameters.cp_model_presolve = False  # costs more than it saves on so small a program
        solver.parameters.linearization_level = 0
        if solver.solve(self._model) not in (self._cp.OPTIMAL, self._cp.FEASIBLE):
            return None
        doers = np.zeros(self._n_tasks, np.int64)
        for (i, a), taken in self._taken.items():
            if solver.boolean_value(taken):
                doers[i] = a
        return doers

"""One round of MuRSE as solvers see it: durations, constraints and what is already fixed.

A solver returns a `Plan`, whose order of dispatch the simulator and the validator time in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.timetable import deadlines_hold, time_order, worst_case


@dataclass(frozen=True, kw_only=True, eq=False)
class Round:
    """N tasks and A agents with known durations; all times are integers from the round's beginning.

    Attributes:
        durations: int64 (N, A), INELIGIBLE where the pair is.
        lags: int64 (N, N), [i, j] how long i waits after j finishes, -1 where it need not.
        near: bool (N, N), pairs that must not overlap.
        deadlines: int64 (N,), latest finish, NO_DEADLINE for none.
        weights: float64 (N,), costs of the weighted completion time.
        fixed: int64 (N,), start of a task that has been committed to, -1 for one that is open.
        agents: int64 (N,), who does the committed tasks, -1 for open ones.
        ready: int64 (A,), when each agent is free at the earliest.
    """

    durations: np.ndarray
    lags: np.ndarray
    near: np.ndarray
    deadlines: np.ndarray
    weights: np.ndarray
    fixed: np.ndarray
    agents: np.ndarray
    ready: np.ndarray

    @classmethod
    def of(cls, instance: MurseInstance, durations: np.ndarray | None = None) -> Round:
        """A whole round of an instance, with the given durations int64 (N, A) or those of its first round."""
        return cls(
            durations=instance.mean_durations if durations is None else np.asarray(durations, np.int64),
            lags=instance.lags,
            near=instance.near,
            deadlines=instance.deadlines,
            weights=instance.weights,
            fixed=np.full(instance.n_tasks, -1, np.int64),
            agents=np.full(instance.n_tasks, -1, np.int64),
            ready=np.zeros(instance.n_agents, np.int64),
        )

    @property
    def n_tasks(self) -> int:
        """Number of tasks."""
        return len(self.durations)

    @property
    def n_agents(self) -> int:
        """Number of agents."""
        return self.durations.shape[1]

    @property
    def eligible(self) -> np.ndarray:
        """Bool (N, A)."""
        return self.durations >= 0

    @property
    def worst(self) -> int:
        """The worst case that an infeasible schedule is charged: the largest sum of one agent's durations."""
        return int(worst_case(self.durations))


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """An order of dispatch and what it comes to under the durations that it was made with.

    Attributes:
        tasks, agents: int64 (K,), the pairs in order of dispatch; K < N if the maker got stuck.
        starts, finishes: int64 (N,), of dispatched tasks.
        makespan: latest finish.
        feasible: every task dispatched, orders consistent, every deadline held.
    """

    tasks: np.ndarray
    agents: np.ndarray
    starts: np.ndarray
    finishes: np.ndarray
    makespan: int
    feasible: bool

    def weighted(self, problem: Round) -> float:
        """Weighted completion time, the sum of weight times finish (section 4.2.1)."""
        return float(problem.weights @ self.finishes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Begun:
    """A round as far as it is committed to, in arrays that a dispatching kernel completes in place.

    Attributes:
        order: int64 (N,), dispatched tasks, of which the first `count` are committed to, by their starts.
        count: how many are committed to.
        doers, finish: int64 (N,), agents and finishes of dispatched tasks.
        free_at: int64 (A,), when each agent is free.
    """

    order: np.ndarray
    count: int
    doers: np.ndarray
    finish: np.ndarray
    free_at: np.ndarray

    @classmethod
    def of(cls, problem: Round) -> Begun:
        """What a problem is committed to; the problem's own arrays are left alone."""
        committed = np.flatnonzero(problem.fixed >= 0)
        committed = committed[np.argsort(problem.fixed[committed], kind="stable")]
        order, finish, doers = np.zeros(problem.n_tasks, np.int64), np.zeros(problem.n_tasks, np.int64), problem.agents
        order[: len(committed)] = committed
        finish[committed] = problem.fixed[committed] + problem.durations[committed, doers[committed]]
        return cls(order=order, count=len(committed), doers=doers.copy(), finish=finish, free_at=problem.ready.copy())

    def plan(self, problem: Round, count: int) -> Plan:
        """The plan, once `count` tasks are dispatched; feasible if those are all, and in time."""
        tasks, starts = self.order[:count], np.zeros(problem.n_tasks, np.int64)
        starts[tasks] = self.finish[tasks] - problem.durations[tasks, self.doers[tasks]]
        return Plan(
            tasks=tasks,
            agents=self.doers[tasks],
            starts=starts,
            finishes=self.finish,
            makespan=int(self.finish.max()),
            feasible=count == problem.n_tasks and bool(deadlines_hold(tasks, self.finish, problem.deadlines)),
        )


def timed(problem: Round, tasks: np.ndarray, agents: np.ndarray) -> Plan:
    """The plan that dispatches these pairs, int64 (K,), in this order at the earliest times.

    Agents' `ready` times and fixed starts are not looked at: it is for whole rounds.
    """
    tasks, agents = np.asarray(tasks, np.int64), np.asarray(agents, np.int64)
    starts, finishes = np.zeros(problem.n_tasks, np.int64), np.zeros(problem.n_tasks, np.int64)
    good = bool(time_order(tasks, agents, problem.durations, problem.lags, problem.near, starts, finishes))
    good = good and bool(deadlines_hold(tasks, finishes, problem.deadlines)) and len(tasks) == problem.n_tasks
    return Plan(
        tasks=tasks,
        agents=agents,
        starts=starts,
        finishes=finishes,
        makespan=int(finishes.max()),
        feasible=good and bool(problem.eligible[tasks, agents].all()),
    )


def plan_cost(problem: Round, plan: Plan, objective: str) -> tuple[bool, float]:
    """What schedulers compare plans by: whether infeasible, then the makespan or the weighted completion time."""
    return not plan.feasible, plan.weighted(problem) if objective == "weighted" else float(plan.makespan)

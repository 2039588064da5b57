"""A round's schedule under construction, on its temporal network (dissertation, sections 3.4.1, 4.2.2 and 4.3.1).

Appending a task to an agent's schedule adds bounds to the full network of `marl_sched.envs.murse.network`: the task
lasts as long as the agent takes for it, starts after the agent's last task, and no open task near it starts before it
has finished. The network is kept closed in O(V^2) for each append, V = 2 N + 2, instead of by all-pairs shortest paths
from scratch: many bounds that lead to the same point are added at once, since no shortest path uses two of them.

It is for whole rounds: what is committed to before (`Round.fixed`, `Round.ready`) is not looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marl_sched.agents.murse.latest_start import shortest_durations
from marl_sched.agents.murse.problem import Plan, Round, timed
from marl_sched.envs.murse.network import END, ORIGIN, finish_point, start_point, task_network
from marl_sched.envs.murse.timetable import longest_round
from marl_sched.kernels import kernel
from marl_sched.temporal_network import UNBOUNDED, close, tighten


@kernel
def tighten_from(distances: np.ndarray, sources: np.ndarray, target: int, bound: int) -> bool:
    """Add `time(target) - time(s) <= bound` for all points s of `sources`, bool (V,), to a closed network, O(V^2).

    False, and nothing is changed, if one of them contradicts the network.
    """
    n = len(distances)
    least = np.full(n, UNBOUNDED, np.int64)
    for source in range(n):
        if sources[source]:
            for u in range(n):
                least[u] = min(least[u], distances[u, source])
    if least[target] < UNBOUNDED and least[target] + bound < 0:
        return False
    for u in range(n):
        first = least[u] + bound
        if least[u] >= UNBOUNDED or first >= distances[u, target]:  # the way over `target` is no shorter than before
            continue
        for v in range(n):
            second = distances[target, v]
            if second < UNBOUNDED and first + second < distances[u, v]:
                distances[u, v] = first + second
    return True


@kernel
def append_bounds(
    distances: np.ndarray, task: int, lasts: int, last: int, still_open: np.ndarray, near: np.ndarray, in_order: bool
) -> bool:
    """Add the bounds of an append to a closed network int64 (V, V) in place; False, half done, if it contradicts it.

    `lasts` is the duration, `last` the agent's last task or -1; still_open and near bool (N,) are the other open tasks
    and those near `task`. With `in_order` no open task starts before this one: the order of appends is one of starts.
    """
    start, finish = start_point(task), finish_point(task)
    if not (tighten(distances, start, finish, lasts) and tighten(distances, finish, start, -lasts)):
        return False
    if last >= 0 and not tighten(distances, start, finish_point(last), 0):
        return False
    sources = np.zeros(len(distances), np.bool_)
    for other in range(len(still_open)):
        sources[start_point(other)] = still_open[other] and near[other]
    if not tighten_from(distances, sources, finish, 0):
        return False
    if not in_order:
        return True
    for other in range(len(still_open)):
        sources[start_point(other)] = still_open[other]
    return tighten_from(distances, sources, start, 0)


@kernel
def simplified(distances: np.ndarray) -> np.ndarray:
    """The minimum distance graph without finishes, int64 (N + 2, N + 2): points s0, f0, s_1, ..., s_N (figure 4.2c)."""
    n = len(distances) // 2 - 1
    points = np.empty(n + 2, np.int64)
    points[0], points[1] = ORIGIN, END
    for task in range(n):
        points[task + 2] = start_point(task)
    out = np.empty((n + 2, n + 2), np.int64)
    for i in range(n + 2):
        for j in range(n + 2):
            out[i, j] = distances[points[i], points[j]]
    return out


@kernel
def next_time(durations: np.ndarray, earliest: np.ndarray, still_open: np.ndarray, free_at: np.ndarray) -> int:
    """The first time at which a free agent can start an open task that it is eligible for; UNBOUNDED if there is none.

    durations int64 (N, A), earliest int64 (N,), still_open bool (N,), free_at int64 (A,).
    """
    first = UNBOUNDED
    for task in range(len(earliest)):
        if still_open[task] and earliest[task] < first:
            for agent in range(len(free_at)):
                if durations[task, agent] >= 0:
                    first = min(first, max(earliest[task], free_at[agent]))
    return first


@dataclass(eq=False)
class PartialSchedule:
    """A round of which some tasks have an agent and a place in that agent's sequence.

    Attributes:
        problem: the round.
        distances: int64 (V, V), its closed network; without meaning once `consistent` is False.
        still_open: bool (N,), tasks without an agent.
        order: the pairs (task, agent) that were appended.
        last: int64 (A,), each agent's last task, -1 for none.
        free_at: int64 (A,), when it has finished that one at the earliest.
        doers: int64 (N,), agents of appended tasks, -1 for open ones.
        consistent: whether a schedule can still hold every deadline and wait, resources of open tasks left aside.
    """

    problem: Round
    distances: np.ndarray
    still_open: np.ndarray
    order: list[tuple[int, int]]
    last: np.ndarray
    free_at: np.ndarray
    doers: np.ndarray
    consistent: bool

    @classmethod
    def of(cls, problem: Round) -> PartialSchedule:
        """A round in which nothing is scheduled yet; its horizon is long enough for any order of tasks."""
        longest = np.where(problem.eligible, problem.durations, 0).max(axis=1)
        horizon = int(longest_round(problem.durations, problem.lags))
        shortest = shortest_durations(problem.durations)
        distances = task_network(shortest, longest, problem.lags, problem.deadlines, horizon)
        consistent = bool(close(distances))
        n, m = problem.n_tasks, problem.n_agents
        return cls(
            problem=problem,
            distances=distances,
            still_open=np.ones(n, np.bool_),
            order=[],
            last=np.full(m, -1, np.int64),
            free_at=np.zeros(m, np.int64),
            doers=np.full(n, -1, np.int64),
            consistent=consistent,
        )

    def copy(self) -> PartialSchedule:
        """An independent copy of the same round."""
        return PartialSchedule(
            problem=self.problem,
            distances=self.distances.copy(),
            still_open=self.still_open.copy(),
            order=list(self.order),
            last=self.last.copy(),
            free_at=self.free_at.copy(),
            doers=self.doers.copy(),
            consistent=self.consistent,
        )

    def append(self, task: int, agent: int, *, in_order: bool = True) -> bool:
        """Give an open task to an eligible agent behind its last one; whether the network is still consistent.

        With `in_order` the tasks that are still open start no earlier than this one.
        """
        lasts, near = int(self.problem.durations[task, agent]), self.problem.near[task]
        self.still_open[task] = False
        self.order.append((task, agent))
        self.doers[task] = agent
        self.consistent = self.consistent and bool(
            append_bounds(self.distances, task, lasts, int(self.last[agent]), self.still_open, near, in_order)
        )
        self.last[agent] = task
        self.free_at[agent] = -self.distances[finish_point(task), ORIGIN]
        return self.consistent

    @property
    def complete(self) -> bool:
        """Whether every task has an agent."""
        return not self.still_open.any()

    @property
    def earliest(self) -> np.ndarray:
        """The earliest start of each task, int64 (N,)."""
        return -self.distances[2::2, ORIGIN]

    @property
    def latest(self) -> np.ndarray:
        """The latest start of each task, int64 (N,)."""
        return self.distances[ORIGIN, 2::2]

    @property
    def makespan(self) -> int:
        """The latest of the earliest finishes of appended tasks, 0 while there are none."""
        finishes = -self.distances[3::2, ORIGIN][~self.still_open]
        return int(finishes.max(initial=0))

    @property
    def now(self) -> int:
        """The first time at which a free agent can start an open task; UNBOUNDED where none ever can."""
        return int(next_time(self.problem.durations, self.earliest, self.still_open, self.free_at))

    def startable(self, time: int, agent: int | None = None) -> np.ndarray:
        """Open tasks, bool (N,), that can start at `time`, those that `agent` is eligible for if one is given."""
        found = self.still_open & (self.earliest <= time)
        return found if agent is None else found & self.problem.eligible[:, agent]

    def start_distances(self) -> np.ndarray:
        """The simplified minimum distance graph, see `simplified`."""
        return np.asarray(simplified(self.distances))

    def plan(self) -> Plan:
        """The plan that dispatches what was appended, in that order; not feasible where tasks are left out."""
        tasks, agents = np.array(self.order, np.int64).reshape(-1, 2).T
        return timed(self.problem, tasks, agents)

"""A batch of MuRSE rounds in padded arrays, and how far a schedule of each has come.

R rows of at most N tasks, A agents and N locations. All times are whole units from the round's beginning, durations are
those that the team believes. Rows are dispatched pair by pair at the earliest starts (marl_sched.envs.murse.rollout).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE
from marl_sched.envs.murse.rollout import Problem, Progress, dispatch
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.kernels import kernel

OPEN = -1  # a task that nobody has


class Rounds(NamedTuple):
    """What is known of R rounds; padded tasks and agents are INELIGIBLE.

    Attributes:
        durations: int64 (R, N, A), believed, INELIGIBLE where the pair is.
        spreads: float64 (R, N, A), standard deviations of what is believed; 0 for robots.
        repetitions: int64 (R, N, A).
        lags: int64 (R, N, N) and `near` bool (R, N, N), as in MurseInstance.
        deadlines: int64 (R, N), NO_DEADLINE for none.
        weights: float64 (R, N), costs of the weighted completion time.
        places: int64 (R, N), index of each task's location.
        sizes: int64 (R, 3), numbers of tasks, agents and robots.
    """

    durations: np.ndarray
    spreads: np.ndarray
    repetitions: np.ndarray
    lags: np.ndarray
    near: np.ndarray
    deadlines: np.ndarray
    weights: np.ndarray
    places: np.ndarray
    sizes: np.ndarray

    @property
    def shape(self) -> tuple[int, int, int]:
        """R, N and A."""
        rows, tasks, agents = self.durations.shape
        return rows, tasks, agents

    def take(self, rows: np.ndarray) -> Rounds:
        """Some of the rows, int64 (K,), one as often as it is named."""
        return Rounds(*[array[rows] for array in self])


class Partial(NamedTuple):
    """Partial schedules of R rounds; `insert` changes them.

    Attributes:
        agents: int64 (R, N), who has each task, OPEN: nobody yet.
        start, finish: int64 (R, N), of tasks that somebody has.
        earliest: int64 (R, N), the least start of open tasks behind what has been dispatched.
        missing: int64 (R, N), how many open tasks each task waits for.
        ready: int64 (R, A), when each agent is free.
    """

    agents: np.ndarray
    start: np.ndarray
    finish: np.ndarray
    earliest: np.ndarray
    missing: np.ndarray
    ready: np.ndarray


def present_rounds(simulator: MurseSimulator, rows: Sequence[int] | np.ndarray) -> Rounds:
    """The present rounds of some rows of a simulator on what the team believes."""
    state, rows = simulator.state, np.asarray(rows, np.int64)
    pairs, header = state.pairs[rows], state.rows[rows]
    n, m = pairs.shape[1:]
    there = (np.arange(n) < header["n_tasks"][:, None])[:, :, None] & (np.arange(m) < header["n_agents"][:, None])[
        :, None
    ]
    eligible = there & (state.base[rows] != INELIGIBLE)
    tasks = state.tasks[rows]
    real = np.arange(n) < header["n_tasks"][:, None]
    return Rounds(
        durations=np.where(eligible, pairs["planned"], INELIGIBLE),
        spreads=np.where(eligible, pairs["spread"], 0.0),
        repetitions=np.where(eligible, pairs["repetitions"], 0),
        lags=state.lags[rows],
        near=state.near[rows],
        deadlines=np.where(real, tasks["deadline"], NO_DEADLINE),
        weights=np.where(real, tasks["weight"], 0.0),
        places=np.where(real, tasks["place"], n - 1),
        sizes=np.stack([header["n_tasks"], header["n_agents"], header["n_robots"]], axis=1).astype(np.int64),
    )


def nothing_dispatched(rounds: Rounds) -> Partial:
    """Empty schedules."""
    r, n, m = rounds.shape
    return Partial(
        agents=np.full((r, n), OPEN),
        start=np.zeros((r, n), np.int64),
        finish=np.zeros((r, n), np.int64),
        earliest=np.zeros((r, n), np.int64),
        missing=(rounds.lags >= 0).sum(axis=2),
        ready=np.zeros((r, m), np.int64),
    )


@kernel
def problem_of_row(rounds: Rounds, partial: Partial, r: int) -> tuple[Problem, Progress]:
    """What is left of a row's round, without padding; the progress is a copy, but for what `dispatch` shall write."""
    n, m = rounds.sizes[r, 0], rounds.sizes[r, 1]
    waits, count = np.empty((n * n, 2), np.int64), 0
    for task in range(n):
        for ahead in range(n):
            if (
                rounds.lags[r, task, ahead] >= 0
                and partial.agents[r, task] == OPEN
                and partial.agents[r, ahead] == OPEN
            ):
                waits[count, 0], waits[count, 1] = task, ahead
                count += 1
    problem = Problem(
        rounds.durations[r, :n, :m],
        rounds.lags[r, :n, :n],
        rounds.near[r, :n, :n],
        rounds.deadlines[r, :n],
        rounds.weights[r, :n],
        waits[:count],
    )
    progress = Progress(
        partial.agents[r, :n] == OPEN,
        partial.missing[r, :n],
        partial.earliest[r, :n],
        partial.finish[r, :n],
        partial.ready[r, :m],
    )
    return problem, progress


@kernel
def insert(rounds: Rounds, partial: Partial, tasks: np.ndarray, agents: np.ndarray, active: np.ndarray) -> None:
    """Dispatch one pair in every active row at its earliest start; tasks, agents int64 (R,), active bool (R,).

    The tasks must be open, heed their waits, and be eligible for the agents: nothing is checked here.
    """
    moved = np.zeros(partial.agents.shape[1], np.bool_)
    for r in range(len(tasks)):
        if active[r]:
            problem, progress = problem_of_row(rounds, partial, r)
            task = tasks[r]
            partial.start[r, task] = dispatch(problem, progress, task, agents[r], moved)
            partial.agents[r, task] = agents[r]


class Charges(NamedTuple):
    """What is added to a schedule's objective.

    Attributes:
        late: for every unit of lateness.
        infeasible: for any lateness at all, as a share of the makespan.
        compact: for every unit of the tasks' mean finish.
    """

    late: float
    infeasible: float
    compact: float


@kernel
def schedule_costs(
    finish: np.ndarray, rounds: Rounds, weighted: bool, charges: Charges
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What whole schedules cost by their finishes, int64 (R, N), and their lateness and makespan.

    Returns float64 (R,) and int64 (R,) twice. The cost is the makespan, or the weighted mean completion time, and what
    is charged.
    """
    r = len(finish)
    costs, lateness, makespans = np.zeros(r), np.zeros(r, np.int64), np.zeros(r, np.int64)
    for row in range(r):
        n, total, ends = rounds.sizes[row, 0], 0.0, 0.0
        for task in range(n):
            end, deadline = finish[row, task], rounds.deadlines[row, task]
            makespans[row] = max(makespans[row], end)
            total += rounds.weights[row, task] * end
            ends += end
            if deadline != NO_DEADLINE:
                lateness[row] += max(end - deadline, 0)
        base = total / max(rounds.weights[row, :n].sum(), 1e-9) if weighted else float(makespans[row])
        any_late = charges.infeasible * makespans[row] if lateness[row] > 0 else 0.0
        costs[row] = base + charges.late * lateness[row] + any_late + charges.compact * ends / n
    return costs, lateness, makespans


@kernel
def time_rows(rounds: Rounds, partial: Partial, orders: np.ndarray) -> None:
    """Dispatch whole schedules, int64 (R, N, 2) of (task, agent) in order, into `partial`, which must be empty."""
    moved = np.zeros(partial.agents.shape[1], np.bool_)
    for r in range(len(orders)):
        problem, progress = problem_of_row(rounds, partial, r)
        for k in range(rounds.sizes[r, 0]):
            task, agent = orders[r, k]
            partial.start[r, task] = dispatch(problem, progress, task, agent, moved)
            partial.agents[r, task] = agent

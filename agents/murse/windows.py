"""When each task of a round can start and has to end, by the temporal network alone."""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.problem import Round
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.network import ORIGIN, finish_point, start_point, task_network
from marl_sched.envs.murse.timetable import longest_round
from marl_sched.temporal_network import close, earliest_times, latest_times


def task_windows(problem: Round) -> tuple[np.ndarray, np.ndarray] | None:
    """Earliest start and latest finish of every task, int64 (N,) each, within the longest round.

    None if the network is inconsistent even with everybody at their shortest.
    """
    shortest = np.where(problem.eligible, problem.durations, np.iinfo(np.int64).max).min(axis=1)
    horizon = int(longest_round(problem.durations, problem.lags))
    network = task_network(shortest, problem.durations.max(axis=1), problem.lags, problem.deadlines, horizon)
    if not close(network):
        return None
    starts, finishes = (slice(point(0), None, point(1) - point(0)) for point in (start_point, finish_point))
    return earliest_times(network, ORIGIN)[starts], latest_times(network, ORIGIN)[finishes]


def induced_deadlines(problem: Round) -> np.ndarray:
    """Deadlines int64 (N,), brought forward to tasks that others with a deadline wait for.

    The deadlines themselves if they cannot all be kept.
    """
    windows = task_windows(problem)
    if windows is None:
        return problem.deadlines
    pressed = problem.deadlines != NO_DEADLINE
    for _ in range(problem.n_tasks):  # at most the longest chain of waits
        pressed = pressed | ((problem.lags >= 0) & pressed[:, None]).any(axis=0)
    return np.where(pressed, windows[1], NO_DEADLINE)

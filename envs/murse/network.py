"""A MuRSE problem as a simple temporal network (dissertation, sections 3.3, 4.3.1 and 5.4.1).

In the full network the points are s0, f0, s_1, f_1, s_2, f_2, ...: origin, end of all, and every task's start
and finish, as in figure 4.2. In the simplified one they are s0, s_1, ..., s_n, f0: a task is its start.
Distances are those of marl_sched.temporal_network.
"""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.kernels import kernel
from marl_sched.temporal_network import relax, unconstrained

ORIGIN, END = 0, 1


@kernel(inline="always")
def start_point(task: int) -> int:
    """The point of the full network at which a task, counted from 0, starts."""
    return 2 + 2 * task


@kernel(inline="always")
def finish_point(task: int) -> int:
    """The point of the full network at which a task, counted from 0, finishes."""
    return 3 + 2 * task


@kernel
def task_network(
    shortest: np.ndarray, longest: np.ndarray, lags: np.ndarray, deadlines: np.ndarray, horizon: int
) -> np.ndarray:
    """The full network, not yet closed, int64 (2 n + 2, 2 n + 2).

    shortest and longest int64 (n,) bound each task's duration (equation 4.2); lags (n, n) and deadlines (n,) as
    in MurseInstance; everything lies between s0 and f0, which are at most `horizon` apart.
    """
    n = len(shortest)
    distances = unconstrained(2 * n + 2)
    relax(distances, ORIGIN, END, horizon)
    relax(distances, END, ORIGIN, 0)
    for i in range(n):
        start, finish = start_point(i), finish_point(i)
        relax(distances, start, ORIGIN, 0)
        relax(distances, END, finish, 0)
        relax(distances, start, finish, longest[i])
        relax(distances, finish, start, -shortest[i])
        if deadlines[i] != NO_DEADLINE:
            relax(distances, ORIGIN, finish, deadlines[i])
        for j in range(n):
            if lags[i, j] >= 0:
                relax(distances, start, finish_point(j), -lags[i, j])
    return distances


@kernel
def simplified_bounds(durations: np.ndarray, lags: np.ndarray, deadlines: np.ndarray, horizon: int) -> np.ndarray:
    """The bounds (source, target, bound) on starts alone, int64 (m, 3), points s0, s_1, ..., s_n, f0.

    Bounds that lead to a finish lead to its start instead, less the duration, int64 (n,) (section 5.4.1).
    """
    n = len(durations)
    bounds, m = np.empty((2 + 3 * n + n * n, 3), np.int64), 2
    bounds[0] = (0, n + 1, horizon)
    bounds[1] = (n + 1, 0, 0)
    for i in range(n):
        bounds[m] = (i + 1, 0, 0)
        bounds[m + 1] = (n + 1, i + 1, -durations[i])
        m += 2
        if deadlines[i] != NO_DEADLINE:
            bounds[m] = (0, i + 1, deadlines[i] - durations[i])
            m += 1
        for j in range(n):
            if lags[i, j] >= 0:
                bounds[m] = (i + 1, j + 1, -lags[i, j] - durations[j])
                m += 1
    return bounds[:m]


@kernel
def network_of(bounds: np.ndarray, n_points: int) -> np.ndarray:
    """The network of int64 (m, 3) bounds, not yet closed, int64 (n_points, n_points).

    Closed, that of `simplified_bounds` is the minimum distance graph of section 4.3.1 without its finishes.
    """
    distances = unconstrained(n_points)
    for k in range(len(bounds)):
        relax(distances, bounds[k, 0], bounds[k, 1], bounds[k, 2])
    return distances

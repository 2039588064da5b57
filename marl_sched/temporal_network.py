"""Simple temporal networks: time points with bounds on their differences (Dechter, Meiri and Pearl, 1991).

A network over n time points is its matrix of distances, int64 (n, n): `distances[u, v]` is the least known
upper bound on `time(v) - time(u)`, UNBOUNDED where there is none. So "v at most b after u" is the bound
(u, v, b) and "v at least w after u" is the bound (v, u, -w). A network in which every entry is the length of
a shortest path is closed (a minimum distance graph, dissertation section 4.3.1); it is consistent when no
point must come before itself. `close` establishes this once in O(n^3), `tighten` keeps it in O(n^2) per bound.

All functions are compiled. The plain ones work on one network (n, n), those named `*_batch` on (B, n, n).
"""

from __future__ import annotations

import numpy as np

from marl_sched.kernels import kernel

UNBOUNDED = 1 << 40
"""The distance between points that no path of bounds connects; real bounds must stay far below it."""


@kernel
def unconstrained(n: int) -> np.ndarray:
    """A network of n points without any bound, int64 (n, n)."""
    distances = np.full((n, n), UNBOUNDED, np.int64)
    for u in range(n):
        distances[u, u] = 0
    return distances


@kernel
def relax(distances: np.ndarray, source: int, target: int, bound: int) -> None:
    """Note `time(target) - time(source) <= bound` without closing the network: for building before `close`."""
    if bound < distances[source, target]:
        distances[source, target] = bound


@kernel
def close(distances: np.ndarray) -> bool:
    """Floyd-Warshall in place, O(n^3); False if the network is inconsistent."""
    n = distances.shape[0]
    for k in range(n):
        for u in range(n):
            first = distances[u, k]
            if first >= UNBOUNDED:
                continue
            for v in range(n):
                second = distances[k, v]
                if second < UNBOUNDED and first + second < distances[u, v]:
                    distances[u, v] = first + second
    return np.diag(distances).min() >= 0


@kernel
def tighten(distances: np.ndarray, source: int, target: int, bound: int) -> bool:
    """Add `time(target) - time(source) <= bound` to a closed network and close it again, O(n^2).

    False, and nothing is changed, if the bound contradicts the network.
    """
    back = distances[target, source]
    if back < UNBOUNDED and back + bound < 0:
        return False
    if bound >= distances[source, target]:
        return True
    n = distances.shape[0]
    for u in range(n):
        first = distances[u, source]
        if first >= UNBOUNDED:
            continue
        for v in range(n):
            second = distances[target, v]
            if second < UNBOUNDED and first + bound + second < distances[u, v]:
                distances[u, v] = first + bound + second
    return True


@kernel
def earliest_times(distances: np.ndarray, origin: int) -> np.ndarray:
    """The earliest time of every point with the origin at 0, int64 (n,), -UNBOUNDED where nothing holds it back."""
    return -distances[:, origin].copy()


@kernel
def latest_times(distances: np.ndarray, origin: int) -> np.ndarray:
    """The latest time of every point with the origin at 0, int64 (n,), UNBOUNDED where nothing presses it."""
    return distances[origin, :].copy()


@kernel
def close_batch(distances: np.ndarray) -> np.ndarray:
    """`close` for each of (B, n, n) in place; bool (B,), which are consistent."""
    consistent = np.empty(distances.shape[0], np.bool_)
    for b in range(distances.shape[0]):
        consistent[b] = close(distances[b])
    return consistent


@kernel
def tighten_batch(distances: np.ndarray, sources: np.ndarray, targets: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """`tighten` for each of (B, n, n) by its own bound, int64 (B,) each; bool (B,), which are still consistent."""
    consistent = np.empty(distances.shape[0], np.bool_)
    for b in range(distances.shape[0]):
        consistent[b] = tighten(distances[b], sources[b], targets[b], bounds[b])
    return consistent

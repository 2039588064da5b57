"""The temporal network against SciPy's Floyd-Warshall and the dissertation's figure 4.2."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import NegativeCycleError, csgraph_from_dense, floyd_warshall

from marl_sched.temporal_network import (
    UNBOUNDED,
    close,
    close_batch,
    earliest_times,
    latest_times,
    relax,
    tighten,
    tighten_batch,
    unconstrained,
)

bounds = st.integers(2, 9).flatmap(
    lambda n: st.tuples(
        st.just(n),
        st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1), st.integers(-8, 25)), max_size=30),
    )
)

# Figure 4.2b: s0, f0, s1, f1, s2, f2, s3, f3.
FIGURE_4_2 = np.array(
    [
        [0, 30, 26, 30, 15, 23, 1, 8],
        [-15, 0, -4, 0, -15, -7, -14, -7],
        [-11, 19, 0, 4, -11, -3, -10, -3],
        [-15, 15, -4, 0, -15, -7, -14, -7],
        [0, 30, 26, 30, 0, 8, 1, 8],
        [-8, 22, 18, 22, -8, 0, -7, 0],
        [0, 30, 26, 30, 15, 23, 0, 7],
        [-7, 23, 19, 23, 8, 16, -7, 0],
    ]
)


def figure_4_2_bounds() -> list[tuple[int, int, int]]:
    """Durations 4, 8, 7; everything between s0 and f0 within 30; f3 <= 8; s1 at least 3 after f2."""
    found = [(0, 1, 30)]
    for task, duration in enumerate((4, 8, 7)):
        start, finish = 2 + 2 * task, 3 + 2 * task
        found += [(start, finish, duration), (finish, start, -duration), (start, 0, 0), (1, finish, 0)]
    return [*found, (0, 7, 8), (2, 5, -3)]


def scipy_distances(n: int, edges: list[tuple[int, int, int]]) -> np.ndarray | None:
    """Shortest distances by SciPy, inf where there is no path, or None for a negative cycle."""
    dense = np.full((n, n), np.inf)
    np.fill_diagonal(dense, 0)
    for source, target, bound in edges:
        if source == target and bound < 0:
            return None
        dense[source, target] = min(dense[source, target], bound)
    try:
        return floyd_warshall(csgraph_from_dense(dense, null_value=np.inf), directed=True)
    except NegativeCycleError:
        return None


def as_float(distances: np.ndarray) -> np.ndarray:
    return np.where(distances >= UNBOUNDED, np.inf, distances)


@given(bounds)
@settings(max_examples=300, deadline=None)
def test_closing_gives_scipys_distances_and_finds_its_negative_cycles(problem):
    n, edges = problem
    distances = unconstrained(n)
    for edge in edges:
        relax(distances, *edge)
    expected = scipy_distances(n, edges)
    assert close(distances) == (expected is not None)
    if expected is not None:
        np.testing.assert_array_equal(as_float(distances), expected)


@given(bounds)
@settings(max_examples=300, deadline=None)
def test_adding_bounds_one_at_a_time_gives_the_same_network_as_all_at_once(problem):
    n, edges = problem
    distances, accepted = unconstrained(n), []
    for edge in edges:
        before = distances.copy()
        if tighten(distances, *edge):
            accepted.append(edge)
        else:
            assert scipy_distances(n, [*accepted, edge]) is None
            np.testing.assert_array_equal(distances, before)
    np.testing.assert_array_equal(as_float(distances), scipy_distances(n, accepted))


def test_figure_4_2_has_the_printed_distances():
    distances = unconstrained(8)
    for edge in figure_4_2_bounds():
        relax(distances, *edge)
    assert close(distances)
    np.testing.assert_array_equal(distances, FIGURE_4_2)


def test_figure_4_2_gives_task_1_a_window_from_11_to_26():
    earliest, latest = earliest_times(FIGURE_4_2, 0), latest_times(FIGURE_4_2, 0)
    assert (earliest[2], latest[2]) == (11, 26)
    assert (earliest[6], latest[6]) == (0, 1)


def test_batched_networks_do_not_influence_each_other():
    distances = np.stack([FIGURE_4_2, unconstrained(8)])
    assert close_batch(distances).tolist() == [True, True]
    # Task 1 before task 3 contradicts the deadline of the first network and nothing in the second.
    still = tighten_batch(distances, np.array([6, 6]), np.array([3, 3]), np.array([0, 0]))
    assert still.tolist() == [False, True]
    np.testing.assert_array_equal(distances[0], FIGURE_4_2)
    assert distances[1, 6, 3] == 0

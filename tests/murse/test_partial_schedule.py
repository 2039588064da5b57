"""A schedule under construction on its temporal network."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import NegativeCycleError, csgraph_from_dense, floyd_warshall

from marl_sched.agents.murse.partial_schedule import PartialSchedule
from marl_sched.agents.murse.problem import Round
from marl_sched.envs.murse.network import END, ORIGIN, finish_point, start_point
from marl_sched.temporal_network import UNBOUNDED
from tests.murse.problems import instances, three_tasks


def edges_of(problem: Round, order: list[tuple[int, int]], horizon: int, in_order: bool) -> list[tuple[int, int, int]]:
    """The bounds (source, target, bound) of a schedule under construction, as section 3.4.1 states them."""
    doers, n = dict(order), problem.n_tasks
    edges = [(ORIGIN, END, horizon), (END, ORIGIN, 0)]
    for i in range(n):
        lasts = problem.durations[i][problem.durations[i] >= 0]
        longest, shortest = lasts.max(), lasts.min()
        if i in doers:
            longest = shortest = problem.durations[i, doers[i]]
        s, f = start_point(i), finish_point(i)
        edges += [(s, ORIGIN, 0), (END, f, 0), (s, f, longest), (f, s, -shortest)]
        edges += [(ORIGIN, f, problem.deadlines[i])] if problem.deadlines[i] >= 0 else []
        edges += [(s, finish_point(j), -problem.lags[i, j]) for j in range(n) if problem.lags[i, j] >= 0]
    for place, (i, agent) in enumerate(order):
        before = [j for j, a in order[:place] if a == agent]
        edges += [(start_point(i), finish_point(before[-1]), 0)] if before else []
        for k in set(range(n)) - {j for j, _ in order[: place + 1]}:
            edges += [(start_point(k), start_point(i), 0)] if in_order else []
            edges += [(start_point(k), finish_point(i), 0)] if problem.near[i, k] else []
    return edges


def closed(edges: list[tuple[int, int, int]], n_points: int) -> np.ndarray | None:
    """SciPy's all-pairs shortest paths, float64; None for a network with a negative cycle."""
    bounds = np.full((n_points, n_points), np.inf)
    np.fill_diagonal(bounds, 0.0)
    for source, target, bound in edges:
        bounds[source, target] = min(bounds[source, target], bound)
    if (np.diag(bounds) < 0).any():
        return None
    try:
        found = floyd_warshall(csgraph_from_dense(bounds, null_value=np.inf))  # where 0 is an edge
    except NegativeCycleError:
        return None
    return None if (np.diag(found) < 0).any() else found


@settings(max_examples=60, deadline=None)
@given(instances(), st.integers(0, 2**32 - 1), st.booleans())
def test_distances_kept_at_each_append_are_shortest_paths(instance, seed, in_order):
    problem, rng = Round.of(instance), np.random.default_rng(seed)
    schedule = PartialSchedule.of(problem)
    horizon = int(schedule.distances[ORIGIN, END])
    while schedule.consistent and not schedule.complete:
        task = rng.choice(np.flatnonzero(schedule.still_open))
        agent = rng.choice(np.flatnonzero(problem.eligible[task]))
        schedule.append(int(task), int(agent), in_order=in_order)
        expected = closed(edges_of(problem, schedule.order, horizon, in_order), len(schedule.distances))
        assert schedule.consistent == (expected is not None)
        if expected is not None:
            np.testing.assert_array_equal(
                np.where(schedule.distances >= UNBOUNDED, np.inf, schedule.distances), expected
            )
    if schedule.consistent and not in_order:
        plan = schedule.plan()
        np.testing.assert_array_equal(plan.starts, schedule.earliest)
        assert plan.feasible
        assert plan.makespan == schedule.makespan


def test_tasks_start_when_agents_places_and_waits_allow_it():
    schedule = PartialSchedule.of(Round.of(three_tasks()))  # durations 4, 3, 2; 3 is 5 after 1; 1 and 2 share a place
    assert schedule.now == 0
    assert schedule.startable(0).tolist() == [True, True, False]
    assert schedule.earliest.tolist() == [0, 0, 9]  # 4 + 5
    assert schedule.append(0, 0)
    assert schedule.earliest.tolist() == [0, 4, 9]
    assert schedule.now == 4  # the other agent is free, but the place is not
    assert schedule.append(1, 1)
    assert schedule.free_at.tolist() == [4, 7]
    assert schedule.makespan == 7
    assert schedule.append(2, 1)
    assert schedule.complete
    assert schedule.makespan == 11


def test_copy_is_left_alone_when_the_original_goes_on():
    schedule = PartialSchedule.of(Round.of(three_tasks()))
    copy = schedule.copy()
    schedule.append(0, 0)
    assert copy.order == []
    assert copy.earliest.tolist() == [0, 0, 9]


@pytest.mark.parametrize(("deadline", "consistent"), [(6, False), (7, True)])
def test_append_that_breaks_an_open_deadline_is_inconsistent(deadline, consistent):
    problem = Round.of(three_tasks(deadlines=[-1, deadline, -1]))  # task 2 then waits for task 1: 4 + 3
    assert PartialSchedule.of(problem).append(0, 0) is consistent


def test_simplified_graph_has_no_finishes():
    schedule = PartialSchedule.of(Round.of(three_tasks()))
    graph = schedule.start_distances()
    assert graph.shape == (5, 5)
    assert graph[4, 2] == -9  # task 3 starts 4 + 5 after task 1 at the earliest
    assert graph[0, 1] == schedule.distances[ORIGIN, END]

"""Least latest start first: keys and schedules by hand, and against a plain statement of the rule."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings

from marl_sched.agents.murse.backward import backward_keys
from marl_sched.agents.murse.latest_start import (
    MAKESPAN,
    WEIGHTED,
    common_horizon,
    cost,
    generate,
    latest_starts,
    least_latest_start,
    successors,
)
from marl_sched.agents.murse.problem import Round, timed
from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE
from tests.murse.problems import instances, problem


def by_the_text(whole: Round, keys: np.ndarray) -> tuple[list[int], list[int]]:
    """The rule as its definition reads: every pair looked at anew before every dispatch."""
    order: list[int] = []
    doers: list[int] = []
    finish: dict[int, int] = {}
    ready = [0] * whole.n_agents
    while len(order) < whole.n_tasks:
        pairs = []
        for task in range(whole.n_tasks):
            ahead = [other for other in range(whole.n_tasks) if whole.lags[task, other] >= 0]
            if task in order or any(other not in order for other in ahead):
                continue
            release = max(
                [finish[other] + int(whole.lags[task, other]) for other in ahead]
                + [finish[other] for other in order if whole.near[task, other]],
                default=0,
            )
            ends = [
                (max(ready[a], release) + int(whole.durations[task, a]), a, max(ready[a], release))
                for a in range(whole.n_agents)
                if whole.eligible[task, a]
            ]
            pairs.append((task, *min(ends)))
        least = min(end for _, end, _, _ in pairs)
        able = [pair for pair in pairs if pair[3] < least or pair[1] == least]
        task, end, agent, _ = min(able, key=lambda pair: (keys[pair[0]], pair[1], pair[0]))
        order.append(task)
        doers.append(agent)
        finish[task] = ready[agent] = end
    return order, doers


def test_latest_starts_go_backwards_through_waits_with_shortest_durations():
    # Task 3 (at least 2 units) has to end by 20, so it starts by 18; task 2 (at least 4) ends 5 earlier, by 13, and
    # starts by 9; task 1 (at least 3) may itself end by 30 but task 2 follows at once: it starts by 9 - 3 = 6.
    # Task 4 has no deadline: it has to end by the horizon of 50 and takes 10.
    lags = np.full((4, 4), -1)
    lags[2, 1], lags[1, 0] = 5, 0
    durations = np.array([[3, 7], [8, 4], [2, INELIGIBLE], [INELIGIBLE, 10]])
    keys = latest_starts(durations, lags, np.array([30, NO_DEADLINE, 20, NO_DEADLINE]), 50.0)
    assert keys.tolist() == [6.0, 9.0, 18.0, 40.0]


def test_the_common_horizon_is_1_3_mean_loads_over_eligible_pairs():
    # means 5, 6 and 4 of three tasks for two agents: 1.3 x 15 / 2
    assert common_horizon(np.array([[3, 7], [6, 6], [4, INELIGIBLE]])) == 1.3 * 15 / 2


def test_a_task_that_cannot_start_before_the_least_finish_is_no_candidate():
    # Robot 1 alone does tasks 1 (5 units) and 2 (4), robot 2 task 3 (3). Task 2 waits 9 units for task 3. Least
    # finish first: task 3 at 3, and task 1 may start before it. Task 1 has the lower key and goes first, then task 3.
    # Task 2 starts at 3 + 9.
    lags = np.full((3, 3), -1)
    lags[1, 2] = 9
    durations, near = np.array([[5, INELIGIBLE], [4, INELIGIBLE], [INELIGIBLE, 3]]), np.zeros((3, 3), bool)
    order, agents, starts, finishes = generate(durations, lags, near, np.array([1.0, 0.0, 2.0]))
    assert order.tolist() == [0, 2, 1]
    assert agents.tolist() == [0, 1, 0]
    assert starts.tolist() == [0, 12, 0]
    assert finishes.tolist() == [5, 16, 3]


def test_a_task_goes_to_the_agent_that_finishes_it_first_even_if_that_one_is_busy():
    # Both tasks take 2 with robot 1 and 9 with robot 2: the second waits for robot 1 and ends at 4.
    durations, lags, near = np.array([[2, 9], [2, 9]]), np.full((2, 2), -1), np.zeros((2, 2), bool)
    _, agents, _, finishes = generate(durations, lags, near, np.zeros(2))
    assert (agents.tolist(), finishes.tolist()) == ([0, 0], [2, 4])


def test_near_tasks_do_not_overlap():
    # Both could start at 0 with an agent of their own; the urgent task 2 goes first and takes 3.
    durations, lags, near = np.array([[2, 2], [3, 3]]), np.full((2, 2), -1), ~np.eye(2, dtype=bool)
    _, _, starts, _ = generate(durations, lags, near, np.array([1.0, 0.0]))
    assert starts.tolist() == [3, 0]


def test_successors_list_who_waits_and_how_long():
    lags = np.full((3, 3), -1)
    lags[2, 0], lags[1, 0], lags[2, 1] = 4, 0, 7
    first, tasks, times = successors(lags)
    assert first.tolist() == [0, 2, 3, 3]
    assert (tasks.tolist(), times.tolist()) == ([1, 2, 2], [0, 4, 7])


@settings(max_examples=200, deadline=None)
@given(instances())
def test_the_kernel_is_the_rule_as_its_definition_reads(instance):
    whole = Round.of(instance)
    order, agents, starts, finishes, keys = least_latest_start(whole.durations, whole.lags, whole.near, whole.deadlines)
    assert (order.tolist(), agents.tolist()) == by_the_text(whole, keys)
    replayed = timed(whole, order, agents)
    assert np.array_equal(replayed.starts, starts)
    assert np.array_equal(replayed.finishes, finishes)


def test_lateness_comes_before_the_objective():
    # ends 5 and 9, deadlines 4 and none, costs 2 and 1
    ends, deadlines, weights = np.array([5, 9]), np.array([4, NO_DEADLINE]), np.array([2.0, 1.0])
    assert cost(ends, deadlines, weights, MAKESPAN) == (1, 9.0)
    assert cost(ends, deadlines, weights, WEIGHTED) == (1, 19.0)


def test_backward_starts_leave_room_for_all_who_need_a_place_or_an_agent():
    # Tasks 1 and 2 share a place and are due by 10; task 3 has to wait 2 after task 2 and is due by 20. From the end:
    # task 3 starts at 20 - 6, so task 2 has to end by 12, and by 10; ties of 1 and 2 go to 1, which starts at 5.
    robots = [[5, 5], [4, 4], [6, 6]]
    places = [[0, 0], [0, 0], [9, 9]]
    apart = problem(robots, deadlines=[10, 10, 20], waits=[(2, 1, 2)], locations=places)
    assert backward_keys(Round.of(apart)).tolist() == [5, 1, 14]
    # One robot alone has to do all three: task 3 from 14, then as before.
    alone = problem([row[:1] for row in robots], deadlines=[10, 10, 8], locations=[[0, 0], [9, 0], [0, 9]])
    assert backward_keys(Round.of(alone)).tolist() == [5, 1, -5]

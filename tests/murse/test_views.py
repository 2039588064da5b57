"""What an agent sees: the graph by hand, nothing beyond its view, and conflicts with agents it cannot hear."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.envs.murse import graph
from marl_sched.envs.murse.network import network_of, simplified_bounds
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.views import FullView, LocalView
from marl_sched.errors import InvalidOptionError
from marl_sched.temporal_network import close
from tests.murse.problems import instances, play_randomly, played, problem, three_tasks
from tests.murse.test_temporal_network import FIGURE_4_2

NEAR = LocalView(sensing=2.0, comm=2.0)


def seen(simulator: MurseSimulator, agent: int) -> dict[str, np.ndarray]:
    return {name: array[0] for name, array in simulator.observe(np.array([agent])).items()}


def test_simplified_network_of_figure_4_2_is_its_table_without_the_finishes():
    lags = np.full((3, 3), -1)
    lags[0, 1] = 3
    distances = network_of(simplified_bounds(np.array([4, 8, 7]), lags, np.array([-1, -1, 8]), 30), 5)
    assert close(distances)
    kept = [0, 2, 4, 6, 1]  # s0, s1, s2, s3, f0 in the table's order
    expected = FIGURE_4_2[np.ix_(kept, kept)].copy()
    np.testing.assert_array_equal(distances, expected)


def test_sparse_network_holds_only_the_rerouted_bounds_of_section_5_4_1():
    lags = np.full((2, 2), -1)
    lags[1, 0] = 3
    bounds = simplified_bounds(np.array([4, 8]), lags, np.array([-1, 20]), 30)
    bounded = {(u, v): bound for u, v, bound in bounds.tolist()}
    assert bounded == {(0, 3): 30, (3, 0): 0, (1, 0): 0, (2, 0): 0, (3, 1): -4, (3, 2): -8, (0, 2): 12, (2, 1): -7}


def test_graph_of_three_tasks_by_hand():
    observation = seen(MurseSimulator([three_tasks(duration_range=(1, 10), deadlines=[-1, -1, 20])]), 0)
    third = observation["task"][3]
    assert observation["task_mask"].tolist() == [1, 1, 1, 1, 1]
    assert observation["task"][:, graph.PLACEHOLDER].tolist() == [1, 0, 0, 0, 1]
    assert third[graph.MY_DURATION] == pytest.approx(0.2)
    assert third[graph.DEADLINE] == pytest.approx(2.0)
    assert third[graph.WAITS_UNHEEDED] == 1.0
    assert observation["task"][1, graph.WAITED_FOR] == 1.0
    assert observation["located_in"].tolist() == [-1, 0, 0, 1, -1]
    assert observation["near"][:2, :2].tolist() == [[1, 0], [0, 0]]
    assert observation["take_time_attributes"][1, 2, 0] == pytest.approx(0.3)
    assert observation["decider"].tolist() == [0, 0, 0, 0, -1]
    # Task 3 starts at least 4 + 5 after task 1: the bound on (3, 1), and reversed for `aug`.
    assert observation["temporal_attributes"][1, 3, 0] == pytest.approx(-0.9)
    assert observation["aug_attributes"][3, 1, 0] == pytest.approx(-0.9)
    assert observation["visible_share"] == 1.0


def test_commitments_show_with_their_times():
    simulator = played(MurseSimulator([three_tasks(duration_range=(1, 10))]), [1, 2])
    observation = seen(simulator, 0)  # at 4: task 1 is done, task 2 runs until 7
    assert observation["task"][1, graph.FINISHED] == 1.0
    assert observation["task"][2, graph.COMMITTED] == 1.0
    assert observation["task"][2, graph.FINISH] == pytest.approx(0.3)
    assert observation["assigned_to"].tolist() == [-1, 0, 1, -1, -1]
    assert observation["task"][3, graph.EARLIEST_START] == pytest.approx(0.5)
    assert observation["action_mask"].tolist() == [1, 0, 0, 1, 0]


def test_distance_simplification_closes_the_network():
    sparse = seen(MurseSimulator([three_tasks()]), 0)
    closed = seen(MurseSimulator([three_tasks()], simplification="distance"), 0)
    assert "aug" not in closed
    assert closed["temporal"].sum() > sparse["temporal"].sum()


def test_local_view_shows_what_is_near_and_one_wait_away():
    # Robots stand at the origin; task 1 is near, task 2 waits for it far away, task 3 is far and unrelated.
    far = problem([[4, 4]] * 3, locations=[[1, 1], [9, 9], [9, 0]], waits=[(1, 0, 2)])
    observation = seen(MurseSimulator([far], view=NEAR), 0)
    assert observation["task_mask"].tolist() == [1, 1, 1, 0, 1]
    assert observation["visible_share"] == pytest.approx(2 / 3)
    assert observation["action_mask"].tolist() == [1, 1, 0, 0, 0]
    assert (observation["task"][3] == 0).all()


def test_task_that_waits_for_a_hidden_one_cannot_be_chosen():
    # Task 2 is one wait away from task 1; it also waits for task 3, which is out of sight.
    hidden = problem([[4, 4]] * 3, locations=[[1, 1], [9, 9], [9, 0]], waits=[(1, 0, 2), (1, 2, 0)])
    simulator = played(MurseSimulator([hidden], view=LocalView(sensing=2.0, comm=99.0)), [1])
    assert seen(simulator, 1)["task"][2, graph.WAITS_UNHEEDED] == 1.0
    assert seen(simulator, 1)["action_mask"].tolist() == [1, 0, 0, 0, 0]


def test_agents_that_do_not_hear_each_other_meet_a_conflict_and_are_told():
    two = problem([[6, 6], [5, 5], [4, 4]], locations=[[1, 0], [1, 1], [3, 0]], proximity="none")
    deaf = LocalView(sensing=9.0, comm=0.0)
    simulator = played(MurseSimulator([two], view=deaf, mode="online"), [1])
    # At the start both stand at the origin; now robot 0 has gone to task 1 and robot 1 does not hear it.
    before = seen(simulator, 1)
    assert before["action_mask"].tolist() == [1, 1, 1, 1, 0]
    played(simulator, [1])
    assert simulator.conflict[0]
    assert (simulator.time[0], simulator.acting[0]) == (1, 1)
    after = seen(simulator, 1)
    assert after["action_mask"].tolist() == [1, 0, 1, 1, 0]
    assert after["task"][1, graph.COMMITTED] == 1.0
    assert after["assigned_to"][1] == -1
    played(simulator, [2])
    assert simulator.round_results(0).size == 0
    assert seen(simulator, 0)["task"][2, graph.UNSCHEDULED] == 1.0


def test_negative_view_options_are_refused():
    with pytest.raises(InvalidOptionError, match="sensing: expected a number >= 0"):
        LocalView(sensing=-1.0)


def hide_and_change(
    simulator: MurseSimulator, viewer: int, view: LocalView | FullView, rng: np.random.Generator
) -> int:
    """Change everything in row 0 that the viewer must not know; how many things were changed."""
    state, instance = simulator.state, simulator.instances[0]
    n, m, now = instance.n_tasks, instance.n_agents, int(state.rows["clock"][0])
    tasks, pairs, told = state.tasks[0], state.pairs[0], state.private_memory[0]
    places = [np.zeros(2) if a["last_task"] < 0 else instance.locations[a["last_task"]] for a in state.agents[0, :m]]
    heard = [a == viewer or np.hypot(*(places[a] - places[viewer])) <= view.limits[1] for a in range(m)]
    near = np.hypot(*(instance.locations - places[viewer]).T) <= view.limits[0]
    linked = (instance.lags >= 0) | (instance.lags >= 0).T
    sight = near | (linked & near[None, :]).any(axis=1)
    strangers = [a for a in range(m) if not heard[a]]
    changes = 0
    for a in strangers:
        state.agents["free_at"][0, a] += int(rng.integers(1, 50))
        pairs["mean"][:n, a] += rng.uniform(1, 9, n)
        pairs["spread"][:n, a] += 1.0
        pairs["planned"][:n, a] += 3
        changes += 1
    for i in range(n):
        pairs["true"][i, :m] += np.where(instance.eligible[i], rng.integers(1, 9, m), 0)  # nobody knows these
        owner = tasks["agent"][i]
        if owner >= 0 and not heard[owner]:
            tasks["start"][i] += int(rng.integers(1, 9))
            tasks["finish"][i] += int(rng.integers(1, 99))
            if told[viewer, i, 1] < 0:
                tasks["agent"][i] = rng.choice([-1, *strangers])
            changes += 1
        elif owner >= 0 and simulator.mode == "online" and tasks["finish"][i] > now:
            tasks["finish"][i] += int(rng.integers(1, 99))  # a running task's end is not known yet
            changes += 1
        if not sight[i]:
            tasks["weight"][i] += 1.0
            if owner < 0 or not heard[owner]:
                pairs["mean"][i] += 2.0
                pairs["planned"][i] += 2
            changes += 1
    return changes


@given(instances(), st.sampled_from(["plan", "online"]), st.integers(0, 50), st.booleans(), st.integers(0, 12))
@settings(max_examples=200)
def test_nothing_beyond_the_view_changes_what_an_agent_sees(instance, mode, seed, closed, turns):
    view = LocalView(sensing=2.0, comm=1.5)
    simplification = "distance" if closed else "sparse"
    simulator = MurseSimulator([instance], mode=mode, view=view, simplification=simplification)
    rng = np.random.default_rng(seed)
    for _ in range(turns):
        legal = np.flatnonzero(simulator.legal()[0])
        simulator.step(np.array([rng.choice(legal)]))
        if simulator.over[0]:
            return
    agents = range(instance.n_agents)
    before = [seen(simulator, agent) for agent in agents]
    for agent in agents:
        saved = simulator.snapshot(0)
        hide_and_change(simulator, agent, view, rng)
        after = seen(simulator, agent)
        for name, array in before[agent].items():
            np.testing.assert_array_equal(after[name], array, err_msg=name)
        for name in ("tasks", "agents", "pairs"):
            getattr(simulator.state, name)[0] = saved[name]


def test_the_same_changes_show_in_the_full_view():
    far = problem([[4, 4]] * 3, locations=[[1, 1], [9, 9], [9, 0]])
    simulator = played(MurseSimulator([far], view=FullView()), [3])
    before = seen(simulator, 1)
    assert hide_and_change(simulator, 1, NEAR, np.random.default_rng(0)) > 0
    after = seen(simulator, 1)
    assert not np.array_equal(before["task"], after["task"])
    assert not np.array_equal(before["agent"], after["agent"])


@given(instances(), st.integers(0, 9))
@settings(max_examples=40)
def test_rows_and_padding_do_not_influence_what_is_seen(instance, seed):
    others = [three_tasks(), problem([[3] * 5] * 9)]
    alone = MurseSimulator([instance], mode="online", view=NEAR)
    together = MurseSimulator([*others, instance], mode="online", view=NEAR)
    rng = np.random.default_rng(seed)
    while not alone.over[0]:
        small, large = alone.observe(alone.acting), together.observe(together.acting)
        for name, array in small.items():
            corner = large[name][2][tuple(slice(0, size) for size in array[0].shape)]
            np.testing.assert_array_equal(corner, array[0], err_msg=name)
            assert np.count_nonzero(large[name][2] > 0) == np.count_nonzero(array[0] > 0)
        action = rng.choice(np.flatnonzero(small["action_mask"][0]))
        alone.step(np.array([action]))
        together.step(np.array([0, 0, action]))
    assert alone.round_results(0).tolist() == together.round_results(2).tolist()


def test_visible_share_is_one_in_the_full_view_only():
    far = problem([[4, 4]] * 3, locations=[[1, 1], [9, 9], [9, 0]])
    simulator = MurseSimulator([far] * 2, view=NEAR)
    assert simulator.observe_all()["visible_share"].tolist() == [1.0, 1.0]
    assert (simulator.observe(simulator.acting)["visible_share"] < 1.0).all()
    play_randomly(simulator, 0)
    assert simulator.observe(simulator.acting)["action_mask"].tolist() == [[1, 0, 0, 0, 0]] * 2

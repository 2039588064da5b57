"""Features that look ahead, by hand; the roll-out of the rule, by another hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.agents.murse.latest_start import generate, least_latest_start
from marl_sched.agents.murse.problem import Round
from marl_sched.envs.murse import graph, rollout
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.views import LocalView
from tests.murse.problems import instances, played, problem, three_tasks


def seen(simulator: MurseSimulator, agent: int) -> dict[str, np.ndarray]:
    return {name: array[0] for name, array in simulator.observe(np.array([agent])).items()}


def column(observation: dict[str, np.ndarray], feature: int) -> list[float]:
    return observation["task"][:, feature].round(5).tolist()


def test_three_tasks_by_hand():
    """In units of 10. The mean load is (4 + 3 + 2) / 2 = 4.5, the common horizon 1.3 times that, in whole units 5.

    Latest starts: task 3 20 - 2 = 18, task 2 5 - 3 = 2, task 1 the lesser of 5 - 4 = 1 and 18 - 5 - 4 = 9. The rule
    gives task 1 to robot 0 (0 to 4), then task 2, which must not overlap it (4 to 7), then task 3 (9 to 11), each to
    the robot of the lower index among those that finish alike.
    """
    observation = seen(MurseSimulator([three_tasks(duration_range=(1, 10), deadlines=[-1, -1, 20])]), 0)
    assert column(observation, graph.LATEST_START) == pytest.approx([0, 0.1, 0.2, 1.8, 0])
    assert column(observation, graph.SLACK) == pytest.approx([0, 0.1, 0.2, 1.8, 0])
    assert column(observation, graph.TAIL) == pytest.approx([0, 0.7, 0, 0, 0])
    assert column(observation, graph.IS_DUE) == [0, 1, 0, 1, 0]
    assert column(observation, graph.TIME_TO_SPARE) == pytest.approx([0, 0.9, 0, 1.8, 0])
    assert column(observation, graph.RULE_CHOICE) == [0, 1, 0, 0, 0]
    assert column(observation, graph.RANK) == pytest.approx([0.2, 0, 0.1, 0, 0])
    assert column(observation, graph.PLANNED_START) == pytest.approx([0, 0, 0.4, 0.9, 0])
    assert column(observation, graph.PLANNED_MINE) == [0, 1, 1, 1, 0]
    assert column(observation, graph.BREAKS) == [0, 0, 0, 0, 0]
    assert observation["agent"][:, 8] == pytest.approx([1.1, 0])
    assert observation["state"][-2:] == pytest.approx([1.1, 0])


def test_a_task_breaks_what_it_makes_too_late():
    """One robot; task 2 takes 3 and is due at 6, so it has to start by 3; behind task 1 it starts at 5."""
    observation = seen(MurseSimulator([problem([[5], [3]], deadlines=[-1, 6], duration_range=(1, 10))]), 0)
    assert column(observation, graph.BREAKS) == pytest.approx([0, 0.1, 0, 0])
    assert column(observation, graph.BROKEN_TIME) == pytest.approx([0, 0.2, 0, 0])


def test_waiting_lasts_until_the_next_event_and_breaks_what_is_due_before():
    """Robot 0 works on task 1 until 5. Robot 1 may wait until then; task 2, which only it can do, must start by 3."""
    far = problem([[5, 9], [0, 3]], deadlines=[-1, 6], duration_range=(1, 10))
    observation = seen(played(MurseSimulator([far]), [1]), 1)
    assert observation["task"][0, graph.EARLIEST_START] == pytest.approx(0.5)
    assert observation["task"][0, graph.BREAKS] == pytest.approx(0.1)
    assert observation["task"][0, graph.BROKEN_TIME] == pytest.approx(0.2)


def test_regret_is_the_delay_against_the_best_of_the_others():
    """Robot 0 is busy until 5 and would finish task 2 at 5 + 3 = 8, robot 1 at 7."""
    observation = seen(played(MurseSimulator([problem([[5, 9], [3, 7]], duration_range=(1, 10))]), [1]), 1)
    assert observation["task"][2, graph.REGRET] == pytest.approx(-0.1)
    assert observation["use_time_attributes"][2, :, 2] == pytest.approx([0.8, 0.7])
    assert observation["use_time_attributes"][2, :, 3] == pytest.approx([0.1, -0.1])
    assert observation["take_time_attributes"][:, 2, 3] == pytest.approx([0.1, -0.1])


def test_time_of_the_faster_robot_is_worth_more():
    """Ten tasks take robot 0 one unit and robot 1 two: shared out, a unit of robot 0 does what two of robot 1 do.

    The dual's prices are 4/3 and 2/3; twenty steps of multiplicative weights come within a tenth.
    """
    prices = seen(MurseSimulator([problem([[1, 2]] * 10)]), 0)["agent"][:, 7]
    assert prices.sum() == pytest.approx(2.0)
    assert prices == pytest.approx([4 / 3, 2 / 3], abs=0.1)


def test_rule_heeds_nothing_that_is_out_of_sight():
    """Task 2 is hidden: with it robot 0 would start with it, as it is due; without it, it takes task 1."""
    due = problem([[5], [3]], deadlines=[-1, 3], locations=[[1, 0], [9, 0]], duration_range=(1, 10))
    assert seen(MurseSimulator([due]), 0)["task"][:, graph.RULE_CHOICE].tolist() == [0, 0, 1, 0]
    local = seen(MurseSimulator([due], view=LocalView(sensing=2.0, comm=2.0)), 0)
    assert local["task"][:, graph.RULE_CHOICE].tolist() == [0, 1, 0, 0]


@given(instance=instances())
@settings(max_examples=100, deadline=None)
def test_roll_out_is_the_schedule_of_the_rule_by_another_hand(instance: MurseInstance):
    whole = Round.of(instance)
    n, m = whole.durations.shape
    waits = np.argwhere(whole.lags >= 0)
    given_problem = rollout.Problem(whole.durations, whole.lags, whole.near, whole.deadlines, whole.weights, waits)
    shortest, latest, prices, cheapest = np.zeros(n, np.int64), np.zeros(n, np.int64), np.ones(m), np.zeros(n)
    rollout.shortest_durations(whole.durations, shortest)
    horizon = int(rollout.HORIZON_SHARE * rollout.mean_load(whole.durations, m))
    rollout.latest_starts(given_problem, shortest, horizon, latest)
    expected_keys = least_latest_start(whole.durations, whole.lags, whole.near, whole.deadlines)[4]
    assert (np.abs(latest - expected_keys) < 1.0).all()  # the horizon in whole units
    latest = n * latest + np.arange(n)  # without ties, which the two break in different ways
    progress, plan = rollout.new_progress(n, m), rollout.new_plan(n)
    progress.open[:], progress.missing[:] = True, (whole.lags >= 0).sum(axis=1)
    rollout.cheapest_costs(given_problem, prices, cheapest)
    count = rollout.roll_out(given_problem, progress, latest, prices, cheapest, 0.0, rollout.new_choice(n), plan)
    order, agents, starts, finishes = generate(whole.durations, whole.lags, whole.near, latest.astype(float))
    assert plan.tasks[:count].tolist() == order.tolist()
    assert plan.agents[:count].tolist() == agents.tolist()
    assert plan.starts[:count].tolist() == starts[order].tolist()
    assert progress.finish.tolist() == finishes.tolist()


@given(instance=instances(), mode=st.sampled_from(["plan", "online"]), reach=st.sampled_from([1.0, 3.0, 99.0]))
@settings(max_examples=60, deadline=None)
def test_rule_always_chooses_one_legal_action_and_ranks_it_first(instance: MurseInstance, mode: str, reach: float):
    simulator = MurseSimulator([instance], mode=mode, view=LocalView(sensing=reach, comm=reach), horizon=1)
    for _ in range(60):
        if simulator.over.all():
            break
        observation = seen(simulator, int(simulator.acting[0]))
        legal, tasks = np.flatnonzero(observation["action_mask"]), observation["task"]
        chosen = np.flatnonzero(tasks[:, graph.RULE_CHOICE])
        assert len(chosen) == 1
        assert chosen[0] in legal
        ranks = (tasks[legal, graph.RANK] * graph.UNIT_OF_COUNTS).round()
        assert ranks[legal == chosen[0]] == 0
        assert (ranks[legal != chosen[0]] >= 1).all()
        simulator.step(chosen)

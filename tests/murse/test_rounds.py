"""Rounds worked out by hand, and what failing costs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.envs.murse.formats import load
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError
from tests.murse.problems import instances, play_randomly, played, problem, three_tasks


def times(simulator: MurseSimulator) -> dict[int, tuple[int, int]]:
    return {job["task"]: (job["start"], job["finish"]) for job in schedule(simulator)["dispatch"]}


@pytest.mark.parametrize("mode", ["plan", "online"])
def test_three_tasks_by_hand(mode):
    simulator = MurseSimulator([three_tasks()], mode=mode)
    # Robot 0 takes task 1: [0, 4). Robot 1 takes task 2, same place: from 4. Robot 0 is free at 4 and takes
    # task 3, which starts 5 after task 1 ended.
    played(simulator, [1, 2])
    assert (simulator.time[0], simulator.acting[0]) == (4, 0)
    played(simulator, [3])
    assert times(simulator) == {1: (0, 4), 2: (4, 7), 3: (9, 11)}
    assert simulator.terminated[0]
    assert simulator.reward[0] == -11.0
    assert simulator.objectives()["makespan"][0] == 11.0
    assert simulator.objectives()["weighted"][0] == 4.0 + 7.0 + 11.0


def test_distance_keeps_near_tasks_apart_and_far_ones_not():
    near = problem([[4, 4], [3, 3]], locations=[[1, 1], [2, 1]])
    far = problem([[4, 4], [3, 3]], locations=[[1, 1], [2, 1.5]])
    assert times(played(MurseSimulator([near]), [1, 2])) == {1: (0, 4), 2: (4, 7)}
    assert times(played(MurseSimulator([far]), [1, 2])) == {1: (0, 4), 2: (0, 3)}
    assert times(played(MurseSimulator([near], proximity="none"), [1, 2])) == {1: (0, 4), 2: (0, 3)}


def test_waiting_lasts_until_a_task_ends():
    # Robot 0 takes task 1: [0, 4). Robot 1 waits, so both are free at 4 and robot 0 comes first.
    simulator = played(MurseSimulator([three_tasks()], mode="online"), [1, 0])
    assert (simulator.time[0], simulator.acting[0]) == (4, 0)
    assert simulator.free_agents(0).tolist() == [0, 1]


def test_waiting_lasts_until_a_wait_elapses():
    # Task 1 ends at 4, task 3 may start at 9. Robot 0 does task 2 from 4 to 7; robot 1 waits on.
    simulator = played(MurseSimulator([three_tasks()], mode="online"), [1, 0, 2, 0])
    assert (simulator.time[0], simulator.acting[0]) == (7, 0)
    played(simulator, [0, 0])
    assert (simulator.time[0], simulator.acting[0]) == (9, 0)


def test_waiting_ends_when_another_agent_commits_but_takes_a_unit():
    simulator = played(MurseSimulator([three_tasks()], mode="online"), [0])
    assert (simulator.time[0], simulator.acting[0]) == (0, 1)
    played(simulator, [1])
    assert (simulator.time[0], simulator.acting[0]) == (1, 0)


def test_round_ends_infeasible_when_all_wait_for_nothing():
    simulator = played(MurseSimulator([three_tasks()]), [0, 0])
    assert simulator.terminated[0]
    result = simulator.round_results(0)[0]
    assert result["stuck"]
    assert not result["feasible"]
    # The worst case is 4 + 3 + 2 = 9, twice that is more than the longest round of 9 + 5.
    assert simulator.reward[0] == -18.0
    assert simulator.objectives()["makespan"][0] == 9.0


def test_missed_deadline_costs_the_worst_case_and_the_work_goes_on():
    simulator = played(MurseSimulator([three_tasks(deadlines=[-1, 6, -1])]), [1, 2, 3])
    assert times(simulator)[3] == (9, 11)
    assert not simulator.round_results(0)[0]["feasible"]
    assert simulator.reward[0] == -18.0


def test_longest_round_is_charged_where_it_exceeds_the_worst_case():
    simulator = played(MurseSimulator([three_tasks(waits=[(2, 0, 50)])]), [0, 0])
    assert simulator.reward[0] == -59.0


def test_task_can_be_chosen_only_behind_what_it_waits_for():
    simulator = MurseSimulator([three_tasks()])
    assert simulator.legal()[0].tolist() == [1, 1, 1, 0, 0]
    played(simulator, [3])
    # Impossible in truth: the robot idles one unit.
    assert simulator.conflict[0]
    played(simulator, [0])
    assert (simulator.time[0], simulator.acting[0]) == (1, 0)
    played(simulator, [1])
    assert simulator.legal()[0].tolist() == [1, 0, 1, 1, 0]


def test_ineligible_pair_is_never_offered():
    simulator = MurseSimulator([problem([[3, 0], [0, 2]])])
    assert simulator.legal()[0].tolist() == [1, 1, 0, 0]
    played(simulator, [1])
    assert simulator.legal()[0].tolist() == [1, 0, 1, 0]


@pytest.mark.parametrize(
    ("picking", "first"), [("first", 0), ("mean_unscheduled", 1), ("min_unscheduled", 2), ("mean_all", 1)]
)
def test_picking_strategies_of_section_4_2_2(picking, first):
    # Means 6, 4 and 5; least durations 4, 3 and 1.
    simulator = MurseSimulator([problem([[8, 5, 9], [4, 3, 1]])], picking=picking)
    assert simulator.acting[0] == first


def test_mean_over_unscheduled_tasks_forgets_scheduled_ones():
    tasks = [[1, 1, 9], [5, 6, 2]]
    left = played(MurseSimulator([problem(tasks)], picking="mean_unscheduled"), [1])
    every = played(MurseSimulator([problem(tasks)], picking="mean_all"), [1])
    assert left.acting[0] == 2
    assert every.acting[0] == 1


def surprising_human() -> MurseInstance:
    """One robot, one human who takes exactly 20 for each task, which the team does not know."""
    curves = np.tile([10.0, 0.0, 10.0, 0.0, 0.1, 0.0], (3, 1, 1))
    return problem([[30], [30], [30]], curves=curves, durations="stochastic", learning="none", duration_range=(15, 100))


def test_plan_is_made_on_estimates_and_executed_on_true_durations():
    simulator = MurseSimulator([surprising_human()])
    planned = int(simulator.state.pairs["planned"][0, 0, 1])
    assert planned > 40  # the population's mean is about 65
    played(simulator, [1, 2])
    assert simulator.time[0] == 30  # the robot is free first, as far as the plan knows
    played(simulator, [3])
    assert times(simulator) == {1: (0, 30), 2: (0, 20), 3: (30, 60)}


def test_online_the_human_is_free_when_it_is_really_done():
    simulator = played(MurseSimulator([surprising_human()], mode="online"), [1, 2])
    assert (simulator.time[0], simulator.acting[0]) == (20, 1)
    played(simulator, [3])
    assert times(simulator) == {1: (0, 30), 2: (0, 20), 3: (20, 40)}


def test_humans_learn_from_round_to_round_what_they_did():
    curves = np.tile([20.0, 0.0, 20.0, 0.0, np.log(2.0), 0.0], (1, 1, 1))
    alone = problem([[0]], curves=curves, n_rounds=3)
    simulator = MurseSimulator([alone], mode="online")
    for _ in range(3):
        played(simulator, [0, 1] if simulator.acting[0] == 0 else [1])
    # 20 + 20, 20 + 10, 20 + 5; the robot, which cannot do it, waits.
    assert [result["makespan"] for result in simulator.round_results(0)] == [40, 30, 25]
    assert simulator.state.pairs["repetitions"][0, 0, 1] == 3


def test_rounds_follow_each_other_in_time():
    simulator = MurseSimulator([three_tasks(n_rounds=2)])
    played(simulator, [1, 2, 3])
    assert (simulator.time[0], simulator.elapsed[0], simulator.acting[0]) == (11, 7, 0)
    assert not simulator.terminated[0]
    played(simulator, [1, 2])
    assert simulator.time[0] == 15
    assert MurseSimulator([three_tasks(n_rounds=2)], horizon=1).state.rows["n_rounds"][0] == 1


def test_measures_of_each_round_count_an_infeasible_one_with_its_worst_case():
    simulator = MurseSimulator([three_tasks(n_rounds=3)], horizon=4)
    played(simulator, [1, 2, 3, 0, 0])
    rounds = simulator.per_round()
    np.testing.assert_array_equal(rounds["feasible"][0], [1.0, 0.0, np.nan, np.nan])
    np.testing.assert_array_equal(rounds["makespan"][0], [11.0, 9.0, np.nan, np.nan])
    np.testing.assert_array_equal(rounds["makespan_feasible"][0], [11.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(rounds["weighted"][0], [22.0, 27.0, np.nan, np.nan])
    assert simulator.objectives()["makespan"][0] == 10.0
    assert simulator.objectives()["feasible"][0] == 0.5


def test_decision_rewards_sum_to_the_makespan():
    simulator = MurseSimulator([three_tasks()], rewards="decision")
    rewards = [float(played(simulator, [action]).reward[0]) for action in (1, 2, 3)]
    assert rewards == [-4.0, -3.0, -4.0]
    divided = MurseSimulator([three_tasks()], rewards="decision", divisor=2.0)
    assert [float(played(divided, [action]).reward[0]) for action in (1, 2, 3)] == [-2.0, -1.5, -4.0]
    failed = MurseSimulator([three_tasks()], rewards="decision")
    assert sum(float(played(failed, [action]).reward[0]) for action in (1, 0, 0, 0, 0, 0)) == -18.0


def test_published_reward_pays_for_failing_and_ours_does_not():
    # Equation 5.2: nothing was done, so both tasks count with the slowest agent: 2 x 4. Finishing takes 42.
    slow = problem([[1], [3]], waits=[(1, 0, 38)])
    published = {"rewards": "published", "multiplier": 2.0}
    assert played(MurseSimulator([slow], **published), [0]).reward[0] == -8.0
    assert played(MurseSimulator([slow], **published), [1, 2]).reward[0] == -42.0
    assert played(MurseSimulator([slow]), [0]).reward[0] == -42.0


def test_weighted_completion_time_is_the_reward_where_it_is_the_objective():
    simulator = MurseSimulator([three_tasks(weights=[1.0, 2.0, 0.5])], objective="weighted")
    assert played(simulator, [1, 2, 3]).reward[0] == -(4.0 + 2.0 * 7.0 + 0.5 * 11.0)
    failed = MurseSimulator([three_tasks(weights=[1.0, 2.0, 0.5])], objective="weighted")
    assert played(failed, [0, 0]).reward[0] == -18.0 * 3.5


@given(
    instances(),
    st.sampled_from(["plan", "online"]),
    st.sampled_from(["round", "decision"]),
    st.sampled_from(["makespan", "weighted"]),
    st.integers(0, 3),
)
@settings(max_examples=150)
def test_failing_never_pays_better_than_finishing(instance, mode, rewards, objective, seed):
    options = {"mode": mode, "rewards": rewards, "objective": objective, "multiplier": 1.0, "horizon": 1}
    simulator = MurseSimulator([instance], **options)
    paid = play_randomly(simulator, seed, idleness=0.4)[0]
    result = simulator.round_results(0)[0]
    bar = -float(result["longest"]) * (1.0 if objective == "makespan" else instance.weights.sum())
    assert (paid >= bar - 1e-9) if result["feasible"] else (paid <= bar + 1e-9)
    if result["feasible"]:
        assert paid == pytest.approx(-float(result["makespan" if objective == "makespan" else "weighted"]))


@given(instances(), st.sampled_from(["plan", "online"]), st.integers(0, 3))
@settings(max_examples=60)
def test_every_episode_ends_however_idle_the_team(instance, mode, seed):
    simulator = MurseSimulator([instance], mode=mode)
    play_randomly(simulator, seed, idleness=5.0)
    assert simulator.over.all()
    assert len(simulator.round_results(0)) == min(instance.n_rounds, simulator.horizon)


def test_job_shop_operations_run_on_their_machines_in_the_order_of_their_jobs(tmp_path):
    (tmp_path / "two").write_text("2 2\n0 3 1 2\n1 4 0 1\n")
    simulator = MurseSimulator([load(tmp_path / "two")])
    assert times(played(simulator, [1, 3, 4, 2])) == {1: (0, 3), 3: (0, 4), 4: (4, 5), 2: (4, 6)}
    assert simulator.round_results(0)[0]["longest"] == 10


def test_unknown_options_and_impossible_choices_are_refused():
    with pytest.raises(TypeError):
        MurseSimulator([three_tasks()], colour="red")
    with pytest.raises(UnknownNameError, match="did you mean 'online'"):
        MurseSimulator([three_tasks()], mode="onlin")
    with pytest.raises(InvalidOptionError, match="multiplier: expected a number >= 1"):
        MurseSimulator([three_tasks()], multiplier=0.5)
    with pytest.raises(IllegalActionError, match="target 5: expected a task's slot"):
        played(MurseSimulator([three_tasks()]), [5])
    with pytest.raises(InvalidOptionError, match="exceed the padding"):
        MurseSimulator([three_tasks()]).reset(instances=[problem([[1, 1]] * 4)])

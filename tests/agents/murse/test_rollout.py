"""What choices cost when the rule goes on: by hand, and the scheduler that takes the cheapest."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.agents.murse.lst import LeastLatestStart
from marl_sched.agents.murse.rollout import LatestStartRollout, LocalLst
from marl_sched.domain import get_domain
from marl_sched.envs.murse.graph import RULE_CHOICE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.views import LocalView
from marl_sched.errors import InvalidOptionError
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from tests.murse.problems import problem

CROSSED = problem([[2, 9], [9, 2]])


def costs(simulator: MurseSimulator) -> list[float]:
    return LatestStartRollout().costs(simulator, simulator.legal())[0].tolist()


def test_costs_of_two_crossed_tasks_by_hand():
    """Each robot has a task that takes it 2 and one that takes it 9; robot 0 chooses.

    Task 1: both are done at 2, and 0.05 x the mean finish is 0.1. Task 2: robot 0 has it until 9, robot 1 task 1 until
    9 as well, 9 + 0.45. Waiting, robot 0 is back at 1, as robot 1 is free to commit: 3 and 2, 3 + 0.125, and 0.5
    percent of that for waiting. Slot 3 is f0.
    """
    assert costs(MurseSimulator([CROSSED])) == pytest.approx([3.125 * 1.005, 2.1, 9.45, np.inf])


def test_lateness_costs_twice_itself_and_half_the_makespan():
    """As before, task 2 due at 5: behind choice 2 it is 4 late, 9 + 2 x 4 + 0.5 x 9 + 0.45."""
    due = problem([[2, 9], [9, 2]], deadlines=[-1, 5])
    assert costs(MurseSimulator([due]))[2] == pytest.approx(9 + 8 + 4.5 + 0.45)


def test_task_that_is_taken_in_truth_costs_a_unit_of_idleness():
    """Robot 1 does not hear that robot 0 has gone to task 1: choosing it loses a unit, then comes task 2."""
    apart = problem([[2, 9], [9, 2]], locations=[[10, 0], [20, 0]])
    simulator = MurseSimulator([apart], view=LocalView(sensing=99.0, comm=0.0), mode="online")
    simulator.step(np.array([1]))
    assert simulator.legal()[0].tolist() == [1, 1, 1, 0]
    assert costs(simulator)[1:3] == pytest.approx([3 + 0.05 * 2.5, 2.1])


def test_waiting_for_nothing_is_never_chosen():
    """A single robot that waits before anything has begun would wait for ever."""
    assert costs(MurseSimulator([problem([[3]])])) == pytest.approx([np.inf, 3.15, np.inf])


def test_the_local_rule_chooses_what_observations_call_the_rules_choice():
    domain = get_domain("murse")
    simulator = MurseSimulator(domain.instances("small", 5, 2), view=LocalView(sensing=2.0, comm=2.0), mode="online")
    for _ in range(12):
        targets = LocalLst().decide(simulator)
        rows, observation = simulator.observe_acting()
        np.testing.assert_array_equal(targets[rows], observation["task"][..., RULE_CHOICE].argmax(axis=1))
        simulator.step(targets)


def test_the_local_rule_that_sees_all_mostly_plans_as_the_rule_does():
    """It plans anew at every turn, when the common horizon of what is left and ties may have become others."""
    ten = Problem("murse", scale="small", count=10, seed=5, episodes=1, horizon=1)
    alone, planned = (evaluate_scheduler(ten, scheduler) for scheduler in (LocalLst(), LeastLatestStart()))
    assert (alone.measures["makespan"] == planned.measures["makespan"]).sum() >= 8


@pytest.mark.parametrize("scheduler", [LatestStartRollout, LocalLst])
def test_a_negative_margin_is_refused(scheduler: type):
    with pytest.raises(InvalidOptionError, match="margin: expected a number >= 0, got -1"):
        scheduler(margin=-1)


def test_rollout_is_shorter_than_the_rule_that_it_completes_by():
    """The roll-out algorithm improves on its base rule (Bertsekas et al. 1997) on the mean of ten small instances."""
    ten = Problem("murse", scale="small", count=10, seed=5, episodes=1, horizon=1)
    rolled, rule = (
        evaluate_scheduler(ten, scheduler).measures["makespan"].mean()
        for scheduler in (LatestStartRollout(), LeastLatestStart())
    )
    assert rolled < rule

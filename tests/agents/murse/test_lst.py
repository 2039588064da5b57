"""`lst`, `lst-robust` and `lst-search`: one pass, with a margin, within a budget, re-planned online."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from marl_sched.agents.murse.latest_start import MAKESPAN, WEIGHTED, climb, cost, successors
from marl_sched.agents.murse.list_schedule import edf_schedule
from marl_sched.agents.murse.lst import (
    LeastLatestStart,
    LstSearch,
    RobustLst,
    latest_start_keys,
    lst_plan,
    search_plan,
)
from marl_sched.agents.murse.problem import Plan, Round
from marl_sched.agents.murse.snapshot import estimated_round, remaining_round
from marl_sched.envs.murse.generate import generate
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError
from tests.agents.murse.playing import finished
from tests.murse.problems import instances, problem, three_tasks


def late_and_long(whole: Round, plan: Plan) -> tuple[int, int]:
    """The sum of lateness and the makespan of a plan."""
    dated = whole.deadlines != NO_DEADLINE
    return int(np.maximum(plan.finishes - whole.deadlines, 0)[dated].sum()), plan.makespan


def test_lst_holds_a_deadline_behind_a_wait_that_edf_misses():
    # One robot. Task 3 (1 unit, deadline 12) waits 5 units for task 1 (2 units), which has no deadline of its own;
    # task 2 lasts 9 and has to end by 19. Latest starts 12 - 1 - 5 - 2 = 4, 10 and 11: task 1 goes first, then task 2
    # from 2 to 11 and task 3 to 12. By deadline alone task 2 goes first and task 3 ends at 9 + 2 + 5 + 1 = 17.
    instance = problem([[2], [9], [1]], waits=[(2, 0, 5)], deadlines=[-1, 19, 12])
    plan = lst_plan(Round.of(instance))
    assert plan.feasible
    assert plan.finishes.tolist() == [2, 11, 12]
    assert finished(LeastLatestStart(), [instance]).round_results(0)["feasible"][0]
    assert not edf_schedule(Round.of(instance)).feasible


@settings(max_examples=60, deadline=None)
@given(instances())
def test_a_search_is_never_worse_than_the_rule_and_never_worse_with_more_evaluations(instance):
    whole = Round.of(instance)
    costs = [late_and_long(whole, search_plan(whole, evaluations=count, key=7)) for count in (1, 8, 64)]
    assert costs[0] == late_and_long(whole, lst_plan(whole))
    assert costs[0] >= costs[1] >= costs[2]


def test_a_search_minimises_the_weighted_completion_time_where_that_is_the_objective():
    # one robot, durations 2 and 3, costs 1 and 10: the dear one first gives 10 x 3 + 1 x 5 = 35, the other way 52
    whole = Round.of(problem([[2], [3]], weights=[1.0, 10.0]))
    assert search_plan(whole, evaluations=50, objective="weighted").weighted(whole) == 35.0


def test_a_search_that_is_continued_equals_one_without_a_break():
    whole = Round.of(generate("medium", np.random.default_rng(5)))
    outcomes = []
    for stops in ((40,), (7, 23, 40)):
        keys, done = latest_start_keys(whole), 1
        arrays = [np.zeros(whole.n_tasks, np.int64) for _ in range(4)]
        best = (1 << 40, 0.0)
        for stop in stops:
            best = climb(
                whole.durations, successors(whole.lags), whole.near, whole.deadlines, whole.weights, MAKESPAN,
                whole.ready, arrays[0], 0, arrays[1], arrays[2], arrays[3], keys, best, np.uint64(3), done, stop,
            )  # fmt: skip
            done = stop
        outcomes.append((best, keys.tolist()))
    assert outcomes[0] == outcomes[1]


def test_a_search_without_a_budget_is_refused():
    with pytest.raises(InvalidOptionError, match="evaluations or seconds"):
        search_plan(Round.of(three_tasks()), evaluations=None)
    with pytest.raises(InvalidOptionError, match="evaluations: expected an integer >= 1, got 0"):
        LstSearch(evaluations=0)
    with pytest.raises(InvalidOptionError, match="seconds: expected a number > 0, got 0"):
        LstSearch(seconds=0)
    with pytest.raises(InvalidOptionError, match="margin"):
        RobustLst(margin=-0.5)


def test_a_budget_of_seconds_ends_the_search():
    whole = Round.of(generate("small", np.random.default_rng(1)))
    plan = search_plan(whole, evaluations=None, seconds=0.05)
    assert late_and_long(whole, plan) <= late_and_long(whole, lst_plan(whole))


def human_team(**changed: object) -> MurseSimulator:
    """Two humans who each take 10 on average, with a deviation of 4 of both tasks, in `online` mode."""
    curve = [10.0, 4.0, 0.0, 0.0, 0.0, 0.0]
    instance = problem(
        [[], []], curves=[[curve, curve]] * 2, durations="stochastic", duration_range=(1, 100), **changed
    )
    return MurseSimulator([instance], mode="online")


def test_a_margin_adds_its_share_of_the_spread_to_open_tasks_only():
    simulator = human_team()
    expected, spread = simulator.state.pairs["planned"][0, :2, :2], simulator.state.pairs["spread"][0, :2, :2]
    assert (spread > 0).all()
    with_margin = estimated_round(simulator, 0, 0.5).durations
    assert np.array_equal(with_margin, expected + np.rint(0.5 * spread))
    simulator.step(np.array([1]))
    left = remaining_round(simulator, 0, 0.5)
    assert left.durations[0, 0] == expected[0, 0]
    assert left.durations[1, 0] == with_margin[1, 0]


def test_online_the_rule_plans_again_when_a_task_took_longer_than_expected(monkeypatch):
    planned: list[int] = []
    scheduled = LeastLatestStart.scheduled

    def counted(self, simulator, row, whole):
        planned.append(int((whole.fixed >= 0).sum()))
        return scheduled(self, simulator, row, whole)

    monkeypatch.setattr(LeastLatestStart, "scheduled", counted)
    finished(LeastLatestStart(), [three_tasks()], mode="online")
    assert planned == [0]  # everything went as planned
    planned.clear()
    curve = [10.0, 4.0, 0.0, 0.0, 0.0, 0.0]
    instance = problem([[]] * 6, curves=[[curve] * 2] * 6, durations="stochastic", duration_range=(1, 100))
    finished(LeastLatestStart(), [instance], mode="online", horizon=1)
    assert len(planned) > 1
    assert planned == sorted(planned)


def test_weighted_and_makespan_costs_differ_in_what_they_count():
    whole = Round.of(three_tasks())
    plan = lst_plan(whole)
    assert cost(plan.finishes, whole.deadlines, whole.weights, WEIGHTED)[1] == plan.weighted(whole)

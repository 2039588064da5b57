"""All MuRSE schedulers: confirmed by the validator, never better than the optimum, never an ineligible pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.agents.murse.exact import solve
from marl_sched.agents.murse.genetic import GeneticEdf
from marl_sched.agents.murse.list_schedule import edf_priority, edf_schedule, list_schedule
from marl_sched.agents.murse.optimal import ExactScheduler, RollingScheduler
from marl_sched.agents.murse.problem import Round
from marl_sched.agents.murse.published import GeneticPublished, published_schedule
from marl_sched.agents.murse.schedulers import RULES
from marl_sched.agents.murse.tercio import Tercio, overload
from marl_sched.agents.murse.windows import induced_deadlines, task_windows
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import get_domain
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.rules import PICKING
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError
from tests.agents.murse.playing import assert_confirmed, finished
from tests.murse.problems import instances, problem, three_tasks

names = st.sampled_from(list(RULES))
modes = st.sampled_from(["plan", "online"])


@settings(max_examples=100, deadline=None)
@given(instances(), names, modes)
def test_what_a_scheduler_achieves_the_validator_confirms_and_pairs_are_eligible(instance, name, mode):
    simulator = finished(create_scheduler(name, "murse"), [instance], mode=mode)
    assert_confirmed(simulator)
    for executed in simulator.state.executed[0]:
        done = executed["agent"][: instance.n_tasks] >= 0
        assert instance.eligible[np.flatnonzero(done), executed["agent"][: instance.n_tasks][done]].all()
    assert simulator.objectives()["conflicts"][0] == 0


@settings(max_examples=80, deadline=None)
@given(instances(), names, modes)
def test_no_scheduler_beats_a_proved_optimum(instance, name, mode):
    simulator = finished(create_scheduler(name, "murse"), [instance], mode=mode, durations="deterministic", horizon=1)
    result, solution = simulator.round_results(0)[0], solve(Round.of(instance))
    if solution.status == "infeasible":
        assert not result["feasible"]
    elif result["feasible"]:
        assert result["makespan"] >= solution.bound


@pytest.mark.slow
@settings(max_examples=2000, deadline=None)
@given(instances(), names, modes)
def test_on_thousands_of_problems_simulator_validator_and_solver_agree(instance, name, mode):
    simulator = finished(create_scheduler(name, "murse"), [instance], mode=mode, durations="deterministic", horizon=1)
    assert_confirmed(simulator)
    result, solution = simulator.round_results(0)[0], solve(Round.of(instance))
    if solution.status == "infeasible":
        assert not result["feasible"]
    elif result["feasible"]:
        assert result["makespan"] >= solution.bound


@settings(max_examples=60, deadline=None)
@given(instances(), st.sampled_from(PICKING))
def test_edf_as_a_kernel_is_edf_in_the_simulator(instance, picking):
    simulator = finished(
        create_scheduler("edf", "murse"), [instance], durations="deterministic", horizon=1, picking=picking
    )
    plan = edf_schedule(Round.of(instance), picking)
    executed = simulator.state.executed[0, 0, : instance.n_tasks]
    assert np.array_equal(plan.agents[np.argsort(plan.tasks)], executed["agent"])
    assert np.array_equal(plan.finishes, executed["finish"])
    assert plan.feasible == simulator.round_results(0)[0]["feasible"]


def test_edf_takes_the_earliest_deadline_that_can_start_and_last_those_without_one():
    instance = problem([[2], [2], [2], [2]], deadlines=[-1, 20, 10, 15], waits=[(2, 1, 3)])
    # task 3 has the earliest deadline but waits until 3 after task 2: 4 (deadline 15), 2 (20), 1, then 3 at 4 + 3
    simulator = finished(create_scheduler("edf", "murse"), [instance])
    order = np.argsort(simulator.state.executed[0, 0]["position"])
    assert order.tolist() == [3, 1, 0, 2]
    assert simulator.state.executed[0, 0]["start"].tolist() == [4, 2, 7, 0]


def test_hctf_takes_the_costliest_task_first():
    simulator = finished(create_scheduler("hctf", "murse"), [problem([[2], [2], [2]], weights=[2.0, 9.0, 5.0])])
    assert np.argsort(simulator.state.executed[0, 0]["position"]).tolist() == [1, 2, 0]


def published(instance: MurseInstance) -> tuple[list[int], list[int], bool]:
    """Finishes by task, doers by task and whether the published rule's round was feasible."""
    simulator = finished(create_scheduler("edf-published", "murse"), [instance])
    executed = simulator.state.executed[0, 0]
    return executed["finish"].tolist(), executed["agent"].tolist(), bool(simulator.round_results(0)["feasible"][0])


def test_the_published_rule_passes_over_an_agent_that_would_break_the_initial_network():
    # Robot 1 comes first, as 6.5 < 12.5 on average, but with it task 1 cannot end by 5. Robot 2 takes task 1, and
    # robot 1, asked again, task 2 at once.
    assert published(problem([[6, 5], [7, 20]], deadlines=[5, -1])) == ([5, 7], [1, 0], True)


def test_the_published_rule_takes_a_task_that_finishes_early_before_an_urgent_one():
    # Robot 2 comes first; its earliest finish is task 2's, not the urgent task 1's. Robot 1 would end task 1 at 9,
    # after 5, and is passed over; robot 2, free at 2, is not: the initial network lets it end task 1 at 5.
    assert published(problem([[9, 5], [8, 2]], deadlines=[5, -1])) == ([7, 2], [1, 1], False)


def test_the_published_rule_gets_stuck_where_everybody_is_passed_over():
    # nobody can end task 1 by 4, and both tasks can start now
    simulator = finished(create_scheduler("edf-published", "murse"), [problem([[6, 5], [7, 20]], deadlines=[4, -1])])
    assert simulator.round_results(0)["stuck"][0]
    assert (simulator.state.executed[0, 0]["agent"] == -1).all()


def test_the_published_rule_ranks_by_finish_in_the_initial_network():
    # Task 3 waits for task 1 plus 9 and task 2 for nobody. At 15 the robot could start either at once; the initial
    # network lets task 3 start at 10 and end at 11 and task 2 end at 12.
    instance = problem([[1], [12], [1], [14]], waits=[(2, 0, 9)])
    simulator = finished(create_scheduler("edf-published", "murse"), [instance])
    assert np.argsort(simulator.state.executed[0, 0]["position"]).tolist() == [0, 1, 2, 3]
    without = finished(create_scheduler("edf-published", "murse"), [problem([[1], [12], [1], [14]])])
    assert np.argsort(without.state.executed[0, 0]["position"]).tolist() == [0, 2, 1, 3]


@settings(max_examples=20, deadline=None)
@given(instances())
def test_the_published_search_is_never_worse_than_the_published_rule(instance):
    whole = Round.of(instance)
    first, best = published_schedule(whole), GeneticPublished().evolved(whole, np.random.default_rng(0))
    assert (not best.feasible, best.makespan) <= (not first.feasible, first.makespan)


def test_claims_go_to_whoever_finishes_first_and_are_counted():
    scheduler = create_scheduler("first-claim", "murse")
    simulator = finished(scheduler, [problem([[3, 9], [4, 5]])])
    assert simulator.state.executed[0, 0]["agent"].tolist() == [0, 1]
    assert scheduler.per_round()["messages"][0].tolist() == [2] + [0] * 9
    assert scheduler.per_round()["bytes"][0, 0] > 0


def test_the_schedule_of_a_priority_can_start_from_what_is_committed():
    # task 1 is committed to robot 1 from 2 to 6; robot 2 is free from 3
    whole = Round.of(problem([[4, 4], [3, 3], [2, 2]]))
    begun = Round(
        **{**vars(whole), "fixed": np.array([2, -1, -1]), "agents": np.array([0, -1, -1]), "ready": np.array([6, 3])}
    )
    plan = list_schedule(begun, edf_priority(begun.deadlines))
    assert plan.starts.tolist() == [2, 3, 6]
    assert plan.makespan == 8


@settings(max_examples=40, deadline=None)
@given(instances(), st.integers(0, 9))
def test_evolution_never_loses_to_the_edf_schedule_that_it_starts_from(instance, seed):
    whole = Round.of(instance)
    first, better = edf_schedule(whole), GeneticEdf(3, 20, 10).evolved(whole, np.random.default_rng(seed))
    assert (not better.feasible, better.makespan) <= (not first.feasible, first.makespan)


def test_evolution_is_the_same_for_the_same_episode_and_differs_between_episodes():
    # without deadlines, so that every mutant counts
    instance = replace(get_domain("murse").instances("small", 1, 3)[0], deadlines=np.full(11, -1))
    runs = []
    for episode in (0, 0, 1):
        simulator = MurseSimulator([instance])
        simulator.reset(seed=1, episodes=[episode])
        runs.append(GeneticEdf().plan(simulator, 0))
    assert np.array_equal(runs[0].tasks, runs[1].tasks)
    assert not (np.array_equal(runs[0].tasks, runs[2].tasks) and np.array_equal(runs[0].agents, runs[2].agents))


def test_work_that_does_not_fit_before_a_time_is_found_by_the_analytical_test():
    # two tasks of 4 units are due at 7; on one robot they need 8, on two they fit
    whole = Round.of(problem([[4, 4], [4, 4], [9, 9]], deadlines=[7, 7, -1]))
    windows = task_windows(whole)
    tasks, agents = overload(whole, np.array([0, 0, 1]), *windows)
    assert (tasks.tolist(), agents.tolist()) == ([0, 1], [0, 0])
    assert overload(whole, np.array([0, 1, 1]), *windows) is None


def test_what_an_urgent_task_waits_for_is_urgent_too():
    # task 3 ends by 20 and lasts 4, at least 5 after task 2: task 2 ends by 11; it lasts 3 and waits for task 1: 8
    whole = Round.of(problem([[2], [3], [4], [6]], deadlines=[-1, -1, 20, -1], waits=[(1, 0, 0), (2, 1, 5)]))
    assert induced_deadlines(whole).tolist() == [8, 11, 20, -1]


def test_tercio_finds_the_only_feasible_allocation():
    # both urgent tasks fit only if each robot takes one; EDF gives task 1 to robot 1, on which it takes too long
    instance = problem([[6, 5], [6, 20]], deadlines=[5, 6])
    simulator = finished(Tercio(), [instance])
    assert simulator.round_results(0)["feasible"][0]
    assert simulator.round_results(0)["makespan"][0] == 6
    assert not edf_schedule(Round.of(instance)).feasible


@pytest.mark.parametrize(
    ("name", "options", "piece"),
    [
        ("genetic-edf", {"generations": 0}, "generations"),
        ("genetic-edf", {"mutations": -1}, "mutations"),
        ("tercio", {"allocations": 0}, "allocations"),
        ("exact", {"time_limit": 0.0}, "time_limit"),
        ("cbba", {"radius": -1.0}, "radius"),
    ],
)
def test_impossible_options_are_refused(name, options, piece):
    with pytest.raises(InvalidOptionError, match=piece):
        create_scheduler(name, "murse", **options)


def test_planners_refuse_a_simulator_of_another_domain():
    airme = get_domain("airme")
    simulator = AirmeSimulator(airme.instances("small", 1, 0))
    for scheduler in (ExactScheduler(), RollingScheduler(), Tercio()):
        with pytest.raises(InvalidOptionError, match="expected a simulator of murse"):
            scheduler.decide(simulator)


def test_rows_do_not_influence_each_other():
    problems = get_domain("murse").instances("small", 3, 5)
    for name in ("edf", "edf-published", "genetic-edf", "tessi", "cbba"):
        together = finished(create_scheduler(name, "murse"), problems, horizon=2)
        for row, instance in enumerate(problems):
            alone = finished(create_scheduler(name, "murse"), [instance], horizon=2)
            assert np.array_equal(together.round_results(row), alone.round_results(0)), name


def test_the_three_task_problem_takes_eleven_units_under_every_planner():
    for name in ("exact", "exact-rolling", "tercio", "tessi", "cbba", "edf"):
        simulator = finished(create_scheduler(name, "murse"), [three_tasks()])
        assert simulator.round_results(0)["makespan"][0] == 11, name

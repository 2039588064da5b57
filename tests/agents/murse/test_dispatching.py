"""Dispatching rules: keys by hand, schedules against the turn-by-turn list schedule, and large shops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.agents.murse.dispatching import (
    DISPATCHING_RULES,
    PRIORITY_RULES,
    DispatchingRule,
    dispatched,
    priority,
    remaining,
    urgency_of,
)
from marl_sched.agents.murse.latest_start import successors
from marl_sched.agents.murse.list_schedule import list_schedule
from marl_sched.agents.murse.problem import Round, timed
from marl_sched.agents.murse.schedulers import RULES
from marl_sched.agents.playing import play
from marl_sched.agents.registry import create_scheduler
from marl_sched.envs.murse.instance import INELIGIBLE
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import UnknownNameError
from tests.agents.murse.playing import assert_confirmed, finished
from tests.murse.problems import instances, problem


def by_hand(whole: Round, rule: str) -> np.ndarray:
    """The priority of the rules that do not depend on the time, float64 (N, A), from their definitions."""
    n = whole.n_tasks
    means = np.array([whole.durations[i][whole.eligible[i]].mean() for i in range(n)])
    behind = whole.lags.T >= 0  # [j, i]: i waits for j
    reach = np.eye(n, dtype=bool)
    for _ in range(n):
        reach = reach | (reach.astype(int) @ behind.astype(int) > 0)
    if rule in ("spt", "lpt"):
        return whole.durations * (1.0 if rule == "spt" else -1.0)
    if rule == "wspt":
        return -whole.weights[:, None] / np.maximum(whole.durations, 1e-9)
    value = reach @ means if rule == "mwkr" else reach.sum(axis=1)
    return np.repeat(-np.asarray(value, float)[:, None], whole.n_agents, axis=1)


@settings(max_examples=100, deadline=None)
@given(instances(), st.sampled_from(["spt", "lpt", "wspt", "mopnr"]))
def test_rules_schedule_as_the_turns_of_the_simulator_do(instance, rule):
    whole = Round.of(instance)
    plan, turns = dispatched(whole, rule), list_schedule(whole, by_hand(whole, rule))
    assert np.array_equal(plan.tasks, turns.tasks)
    assert np.array_equal(plan.agents, turns.agents)
    assert np.array_equal(plan.finishes, turns.finishes)


@settings(max_examples=100, deadline=None)
@given(instances(), st.sampled_from([*PRIORITY_RULES, "lst", "genetic-edf", "edf-published"]))
def test_a_round_that_is_played_whole_is_the_one_that_turns_play(instance, name):
    turns = finished(create_scheduler(name, "murse"), [instance])
    whole = play(create_scheduler(name, "murse"), MurseSimulator([instance]))
    for k, result in enumerate(turns.round_results(0)):
        assert whole.round_results(0)[k] == result
        for field in ("agent", "start", "finish"):
            assert np.array_equal(whole.state.executed[0, k][field], turns.state.executed[0, k][field])


def test_the_order_of_dispatch_does_not_change_the_result_of_the_same_times():
    # three tasks of one unit at once: 0.1 + 0.2 + 0.3 and 0.3 + 0.2 + 0.1 differ in the last bit of a float
    instance = problem([[1, 1, 1]] * 3, weights=[0.1, 0.2, 0.3], proximity="none")
    results = []
    for order in ([0, 1, 2], [2, 1, 0]):
        simulator = MurseSimulator([instance])
        simulator.play_round(0, np.array(order), np.array(order))
        results.append(float(simulator.round_results(0)["weighted"][0]))
    assert results == [0.1 + 0.2 + 0.3] * 2


@settings(max_examples=60, deadline=None)
@given(instances(), st.sampled_from(DISPATCHING_RULES), st.sampled_from(["plan", "online"]))
def test_what_a_dispatching_rule_achieves_the_validator_confirms(instance, rule, mode):
    assert_confirmed(finished(DispatchingRule(rule), [instance], mode=mode))


def test_work_and_operations_remaining_count_every_task_behind_once():
    # 1 -> 2 -> 4 and 1 -> 3 -> 4 with mean durations 1, 2, 3, 4: behind task 1 all, 10 units of work
    lags = np.full((4, 4), -1)
    lags[1, 0] = lags[2, 0] = lags[3, 1] = lags[3, 2] = 0
    work, operations = remaining(np.array([1.0, 2.0, 3.0, 4.0]), *successors(lags))
    assert work.tolist() == [10.0, 6.0, 7.0, 4.0]
    assert operations.tolist() == [4, 2, 2, 1]


def test_rules_that_look_at_the_clock_rank_by_their_formulas():
    # Task 1 lasts 4 with robot 1, weighs 3, has to end by 20 and task 2, of 4 units, waits for it and has no deadline:
    # its latest finish is 20, 8 units of work in 2 operations remain, the mean duration is 4. Now 6, startable from 2.
    whole = Round.of(problem([[4], [4]], waits=[(1, 0, 0)], deadlines=[20, 1000], weights=[3.0, 1.0]))

    def value(rule: str) -> float:
        return float(priority(urgency_of(whole, rule), 0, 0, 4, 2, 6))

    assert value("slack-per-operation") == (20 - 6 - 8) / 2
    assert value("atc") == pytest.approx(-3 / 4 * np.exp(-10 / (2 * 4)))
    assert value("fifo") == 2.0
    assert (value("edd"), value("edf"), value("hctf")) == (20.0, 20.0, -3.0)
    assert (value("mwkr"), value("mopnr"), value("wspt")) == (-8.0, -2.0, -3 / 4)


def test_first_in_first_out_takes_what_has_been_startable_for_longest():
    # Robot 1 is busy with task 1 until 9. Task 3 can start from 0, task 2 from 4 on, when robot 2 is done with task 4.
    # By index task 2 would come first.
    instance = problem([[9, 0], [2, 0], [2, 0], [0, 4]], waits=[(1, 3, 0)])
    assert dispatched(Round.of(instance), "fifo").tasks.tolist() == [0, 3, 2, 1]


def test_the_rules_differ_on_a_job_shop():
    # three jobs of two operations on two machines, job j first on machine 1, then on machine 2
    durations = [[5, 0], [0, 1], [2, 0], [0, 9], [3, 0], [0, 4]]
    whole = Round.of(problem(durations, waits=[(1, 0, 0), (3, 2, 0), (5, 4, 0)], proximity="none"))
    firsts = {rule: dispatched(whole, rule).tasks.tolist()[0] for rule in ("spt", "lpt", "mwkr")}
    assert firsts == {"spt": 2, "lpt": 0, "mwkr": 2}
    # by shortest: machine 1 takes 2, 3, 5 units, machine 2 is busy 2-11, 11-15, 15-16
    assert dispatched(whole, "spt").makespan == 16
    # by longest: machine 1 takes 5, 3, 2 units; machine 2 is busy 5-6, 8-12 and, from 10 on waiting, 12-21
    assert dispatched(whole, "lpt").makespan == 21


def test_unknown_rules_are_refused():
    with pytest.raises(UnknownNameError, match="stp"):
        DispatchingRule("stp")


@pytest.mark.parametrize("rule", DISPATCHING_RULES)
def test_a_schedule_of_a_shop_of_two_thousand_operations_is_consistent(rule):
    whole = shop(100, 20, seed=0)
    plan = dispatched(whole, rule)
    replayed = timed(whole, plan.tasks, plan.agents)
    assert plan.feasible
    assert replayed.feasible
    assert np.array_equal(replayed.finishes, plan.finishes)
    assert plan.makespan >= whole.durations.sum(axis=0).max()


def shop(n_jobs: int, n_machines: int, seed: int) -> Round:
    """A job shop of one operation per job and machine, in random order, of 1 to 99 units."""
    rng, n = np.random.default_rng(seed), n_jobs * n_machines
    durations, lags = np.full((n, n_machines), INELIGIBLE, np.int64), np.full((n, n), -1, np.int64)
    for job in range(n_jobs):
        for place, machine in enumerate(rng.permutation(n_machines)):
            operation = job * n_machines + place
            durations[operation, machine] = rng.integers(1, 100)
            if place:
                lags[operation, operation - 1] = 0
    return Round(
        durations=durations, lags=lags, near=np.zeros((n, n), np.bool_), deadlines=np.full(n, -1, np.int64),
        weights=np.ones(n), fixed=np.full(n, -1, np.int64), agents=np.full(n, -1, np.int64),
        ready=np.zeros(n_machines, np.int64),
    )  # fmt: skip


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("mode", ["plan", "online"])
def test_operations_that_take_no_time_are_scheduled_by_everybody(name, mode):
    # two jobs of three operations on three machines; the second operation of job 1 and the first of job 2 take nothing
    rows = [[3, -1, -1], [-1, 0, -1], [-1, -1, 2], [-1, 0, -1], [4, -1, -1], [-1, -1, 1]]
    waits = [(1, 0, 0), (2, 1, 0), (4, 3, 0), (5, 4, 0)]
    instance = replace(problem([[1, 1, 1]] * 6, waits=waits, proximity="none"), robot_durations=np.array(rows))
    simulator = finished(create_scheduler(name, "murse"), [instance], mode=mode)
    assert_confirmed(simulator)
    assert simulator.round_results(0)["feasible"][0]
    # machine 1 takes 7 and one of its operations is last, with at least one unit on machine 3 behind it
    assert simulator.round_results(0)["makespan"][0] >= 8

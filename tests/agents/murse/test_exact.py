"""The exact solver against published optima, against enumeration, and as a scheduler in the simulator."""

from __future__ import annotations

import subprocess
import sys
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.agents.murse.best_rule import best_rule_plan
from marl_sched.agents.murse.exact import WORK_LIMIT, solve
from marl_sched.agents.murse.list_schedule import edf_schedule
from marl_sched.agents.murse.optimal import ExactScheduler, RollingScheduler, is_feasible
from marl_sched.agents.murse.problem import Round, plan_cost, timed
from marl_sched.agents.murse.snapshot import remaining_round
from marl_sched.envs.murse.formats import read_flexible_job_shop, read_job_shop
from marl_sched.envs.murse.generate import generate
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError, UnknownNameError
from tests.agents.murse.playing import finished
from tests.murse.problems import instances, problem, three_tasks

FT06 = """6 6
2 1 0 3 1 6 3 7 5 3 4 6
1 8 2 5 4 10 5 10 0 10 3 4
2 5 3 4 5 8 0 9 1 1 4 7
1 5 0 5 2 5 3 3 4 8 5 9
2 9 1 3 4 5 5 4 0 3 3 1
1 3 3 3 5 9 0 10 4 4 2 1
"""
LA01 = """10 5
1 21 0 53 4 95 3 55 2 34
0 21 3 52 4 16 2 26 1 71
3 39 4 98 1 42 2 31 0 12
1 77 0 55 4 79 2 66 3 77
0 83 3 34 2 64 1 19 4 37
1 54 2 43 4 79 0 92 3 62
3 69 4 77 1 87 2 87 0 93
2 38 0 60 1 41 3 24 4 83
3 17 1 49 4 25 0 44 2 98
4 77 3 79 2 43 1 75 0 96
"""
# Kacem, Hammadi and Borne (2002): 4 jobs, 12 operations, all of 5 machines eligible; the optimum is 11.
KACEM = [
    [[2, 5, 4, 1, 2], [5, 4, 5, 7, 5], [4, 5, 5, 4, 5]],
    [[2, 5, 4, 7, 8], [5, 6, 9, 8, 5], [4, 5, 4, 54, 5]],
    [[9, 8, 6, 7, 9], [6, 1, 2, 5, 4], [2, 5, 4, 2, 4], [4, 5, 2, 1, 5]],
    [[1, 5, 2, 4, 12], [5, 1, 2, 1, 2]],
]


@pytest.mark.parametrize(("text", "optimum"), [(FT06, 55), (LA01, 666)], ids=["ft06", "la01"])
def test_job_shops_are_solved_to_their_published_optima(tmp_path, text, optimum):
    path = tmp_path / "shop.txt"
    path.write_text(text)
    instance = read_job_shop(path)
    solution = solve(Round.of(instance), time_limit=120)
    assert (solution.status, solution.objective, solution.bound, solution.gap) == ("optimal", optimum, optimum, 0.0)
    assert instance.eligible[solution.plan.tasks, solution.plan.agents].all()
    replayed = timed(Round.of(instance), solution.plan.tasks, solution.plan.agents)
    assert replayed.feasible
    assert replayed.makespan == optimum


def test_a_flexible_job_shop_is_solved_to_its_published_optimum(tmp_path):
    lines = ["4 5"]
    for job in KACEM:
        pairs = [f"5 {' '.join(f'{m + 1} {t}' for m, t in enumerate(times))}" for times in job]
        lines.append(f"{len(job)} {' '.join(pairs)}")
    path = tmp_path / "kacem.fjs"
    path.write_text("\n".join(lines))
    solution = solve(Round.of(read_flexible_job_shop(path)), time_limit=120)
    assert (solution.status, solution.objective) == ("optimal", 11)


def by_enumeration(whole: Round) -> float:
    """The least makespan over all dispatch orders and allocations, inf if none is feasible."""
    best = np.inf
    doers = [np.flatnonzero(row) for row in whole.eligible]
    for order in permutations(range(whole.n_tasks)):
        for agents in product(*doers):
            plan = timed(whole, np.array(order), np.array(agents)[list(order)])
            if plan.feasible:
                best = min(best, plan.makespan)
    return best


@settings(max_examples=25, deadline=None)
@given(instances().filter(lambda i: i.n_tasks <= 4 and i.n_agents <= 3))
def test_the_optimum_is_that_of_trying_everything(instance):
    whole = Round.of(instance)
    solution = solve(whole)
    best = by_enumeration(whole)
    assert solution.status == ("infeasible" if best == np.inf else "optimal")
    if solution.plan is not None:
        assert solution.objective == best


def test_the_weighted_completion_time_puts_the_costly_task_first():
    # one robot, durations 2 and 3; costs 1 and 10: dear one first gives 10 x 3 + 1 x 5 = 35, the other way 2 + 50
    instance = problem([[2], [3]], weights=[1.0, 10.0])
    solution = solve(Round.of(instance), objective="weighted")
    assert (solution.status, solution.objective) == ("optimal", 35.0)
    assert solution.plan.tasks.tolist() == [1, 0]
    assert solution.plan.weighted(Round.of(instance)) == 35.0


def test_infeasible_problems_are_said_to_be():
    hopeless = problem([[5], [5]], deadlines=[7, 7])
    solution = solve(Round.of(hopeless))
    assert (solution.status, solution.plan) == ("infeasible", None)
    assert not is_feasible(hopeless)
    scheduler = ExactScheduler()
    simulator = finished(scheduler, [hopeless])
    assert scheduler.solutions[0, 0].status == "infeasible"
    assert not simulator.round_results(0)["feasible"][0]


def test_a_limit_that_comes_first_leaves_a_plan_no_worse_than_the_best_rule_and_is_told():
    whole = Round.of(generate("large", np.random.default_rng(2)))
    first = best_rule_plan(whole)
    solution = solve(whole, work_limit=0.05, start=first)
    assert first.feasible
    assert (solution.status, solution.timed_out) == ("feasible", True)
    assert (solution.work_limit, solution.time_limit, solution.threads) == (0.05, None, 1)
    assert solution.bound < solution.objective <= first.makespan
    assert timed(whole, solution.plan.tasks, solution.plan.agents).makespan == solution.objective


def test_a_run_on_one_thread_without_a_wall_clock_is_the_same_every_time():
    whole = Round.of(generate("medium", np.random.default_rng(2)))
    runs = [solve(whole, work_limit=0.3) for _ in range(2)]
    assert runs[0].work == runs[1].work
    assert runs[0].bound == runs[1].bound
    assert (runs[0].plan is None) == (runs[1].plan is None)
    assert runs[0].plan is None or np.array_equal(runs[0].plan.starts, runs[1].plan.starts)


def test_the_limit_is_one_of_work_unless_another_is_given():
    whole = Round.of(three_tasks())
    assert (solve(whole).work_limit, solve(whole).time_limit) == (WORK_LIMIT, None)
    assert (solve(whole, time_limit=5).work_limit, solve(whole, time_limit=5).time_limit) == (None, 5)


@settings(max_examples=40, deadline=None)
@given(instances(), st.sampled_from(["makespan", "weighted"]))
def test_a_run_is_never_worse_than_what_it_started_from(instance, objective):
    whole = Round.of(instance)
    first = best_rule_plan(whole, objective)
    solution = solve(whole, objective=objective, start=first)
    if first.feasible:
        assert solution.status == "optimal"
        assert plan_cost(whole, solution.plan, objective) <= plan_cost(whole, first, objective)
        assert solution.improved == (solution.plan is not first)


INTERRUPTED = """
import os, signal, threading
import numpy as np
from marl_sched.agents.murse import exact
from marl_sched.agents.murse.problem import Round
from marl_sched.envs.murse.generate import generate

exact.ortools()  # imported before the interrupt, which comes half a second on
whole = Round.of(generate("heterogeneous-10-large", np.random.default_rng(0)))
# Kernels are loaded first: CPython ends by SIGINT once an interrupt has left an `exec`, as Numba's, even if caught.
exact.solve(Round.of(generate("small", np.random.default_rng(0))), work_limit=0.01)
print("solving", flush=True)
threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    exact.solve(whole, time_limit=3600)  # a large problem, which no limit ends
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def test_an_interrupt_ends_the_run():
    # a process of its own: an interrupt that comes too early or too late must not end the tests' process
    ended = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=300, check=False
    )
    assert (ended.returncode, ended.stdout) == (0, "solving\ninterrupted\n"), ended.stderr


def test_a_round_without_a_feasible_plan_is_counted_and_solved_ones_tell_their_bounds():
    scheduler = ExactScheduler()
    finished(scheduler, [problem([[5], [5]], deadlines=[7, 7]), problem([[5], [5]])], horizon=1)
    measures = scheduler.per_round()
    assert measures["without_plan"].tolist() == [[1.0], [0.0]]
    assert measures["optimal"].tolist() == [[0.0], [1.0]]
    assert measures["timed_out"].tolist() == [[0.0], [0.0]]
    assert np.isnan(measures["bound"][0, 0])
    assert measures["bound"][1, 0] == 10.0


def test_a_margin_makes_the_rolling_solver_plan_with_longer_durations():
    curve = [10.0, 4.0, 0.0, 0.0, 0.0, 0.0]
    instance = problem([[]] * 2, curves=[[curve]] * 2, durations="stochastic", duration_range=(1, 100))
    lengths = []
    for margin in (0.0, 1.0):
        scheduler = RollingScheduler(margin=margin)
        simulator = MurseSimulator([instance], mode="online")
        scheduler.start(simulator, np.ones(1, bool))
        scheduler.decide(simulator)
        lengths.append(scheduler.solutions[0, 0].objective)
    spread = simulator.state.pairs["spread"][0, :2, 0]
    assert lengths[1] - lengths[0] == np.rint(spread).sum() > 0


def test_unknown_objectives_and_times_are_refused():
    whole = Round.of(three_tasks())
    with pytest.raises(UnknownNameError, match="makespn"):
        solve(whole, objective="makespn")
    with pytest.raises(InvalidOptionError, match="time_limit"):
        solve(whole, time_limit=0)
    with pytest.raises(InvalidOptionError, match="work_limit"):
        solve(whole, work_limit=0)
    with pytest.raises(InvalidOptionError, match="threads"):
        ExactScheduler(threads=0)
    with pytest.raises(InvalidOptionError, match="time_limit"):
        RollingScheduler(time_limit=-1)
    with pytest.raises(InvalidOptionError, match="margin"):
        RollingScheduler(margin=-1)


@settings(max_examples=30, deadline=None)
@given(instances(), st.sampled_from(["plan", "online"]))
def test_a_followed_plan_takes_as_long_as_the_solver_says_when_durations_are_known(instance, mode):
    scheduler = ExactScheduler()
    simulator = finished(scheduler, [instance], mode=mode, durations="deterministic", horizon=3)
    for k, result in enumerate(simulator.round_results(0)):
        solution = scheduler.solutions[0, k]
        assert result["feasible"] == (solution.plan is not None)
        if solution.plan is not None:
            assert result["makespan"] == solution.objective


def test_where_nothing_goes_wrong_the_rolling_plan_stays_as_it_is(monkeypatch):
    solved = []
    monkeypatch.setattr(
        "marl_sched.agents.murse.optimal.solve", lambda *args, **options: solved.append(1) or solve(*args, **options)
    )
    simulator = finished(RollingScheduler(), [three_tasks()], mode="online")
    assert simulator.round_results(0)["makespan"][0] == 11
    assert len(solved) == 1


def test_what_is_committed_to_stays_and_running_tasks_end_as_estimated():
    # two robots; task 1 (4 units) runs from 0, task 2 waits 5 units for it, task 3 is open
    simulator = MurseSimulator([three_tasks(waits=[(1, 0, 5)], proximity="none")], mode="online")
    simulator.step(np.array([1]))
    left = remaining_round(simulator, 0)
    assert left.fixed.tolist() == [0, -1, -1]
    assert left.agents.tolist() == [0, -1, -1]
    assert left.ready.tolist() == [4, 0]
    solution = solve(left)
    assert (solution.status, solution.objective) == ("optimal", 12)  # 4, then 5 of waiting, then 3
    assert solution.plan.starts[0] == 0


def test_an_open_task_keeps_behind_a_committed_one_that_is_near():
    # task 1 is committed from 3 to 5 at the place of task 2, which lasts 2: before it there is room, but it goes behind
    instance = problem([[2, 0], [0, 2]], locations=[[1, 1], [1, 1]])
    whole = Round.of(instance)
    committed = Round(
        **{**vars(whole), "fixed": np.array([3, -1]), "agents": np.array([0, -1]), "ready": np.array([5, 0])}
    )
    assert solve(committed).plan.starts.tolist() == [3, 5]


def test_generated_problems_can_be_drawn_until_one_is_solvable():
    instance = generate("small", np.random.default_rng(3), is_feasible)
    assert solve(Round.of(instance)).plan is not None


def test_edf_is_never_better_than_a_proved_optimum_on_generated_problems():
    for seed in range(3):
        whole = Round.of(generate("small", np.random.default_rng(seed)))
        plan, solution = edf_schedule(whole), solve(whole)
        if plan.feasible and solution.status == "optimal":
            assert plan.makespan >= solution.objective

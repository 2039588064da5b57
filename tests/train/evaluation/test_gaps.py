"""Gaps count what both could do, and a row for every instance says how the solver ended."""

from __future__ import annotations

import numpy as np

from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import Scores
from marl_sched.train.evaluation.gaps import by_instance, gaps
from marl_sched.train.evaluation.results import Gap, InstanceScores


def scores(makespan: list[float], feasible: list[float], **rounds: list[float]) -> Scores:
    """Two instances, one episode, one round each."""
    per_round = {"makespan": makespan, "feasible": feasible, **rounds}
    shaped = {name: np.array(values, np.float64).reshape(2, 1, 1) for name, values in per_round.items()}
    return Scores(measures={"makespan": shaped["makespan"][..., 0]}, visible_share=1.0, seconds=1.0, per_round=shaped)


RULE = scores([60.0, 500.0], [1.0, 0.0])
EXACT = scores(
    [50.0, 80.0],
    [1.0, 1.0],
    bound=[48.0, 80.0],
    optimal=[0.0, 1.0],
    timed_out=[1.0, 0.0],
    without_plan=[0.0, 0.0],
    solver_seconds=[10.0, 0.5],
)


def test_rounds_that_one_of_the_two_could_not_do_have_no_gap():
    # the rule's second round was infeasible and charged 500; the first is 60 against 50, and against the bound of 48
    to_exact, to_bound = gaps(RULE, EXACT, "makespan")
    assert to_exact == Gap(mean=20.0, std=0.0, rounds=1)
    assert to_bound == Gap(mean=25.0, std=0.0, rounds=1)
    assert gaps(scores([500.0, 500.0], [0.0, 0.0]), EXACT, "makespan")[0] == Gap(mean=None, std=None, rounds=0)


def test_every_instance_has_a_row_that_says_how_the_solver_ended():
    rows = by_instance(Problem("murse", count=2), {"rule": RULE, "exact": EXACT})
    assert [row.schedulers["rule"] for row in rows] == [
        InstanceScores(objective=60.0, feasible=1.0),
        InstanceScores(objective=500.0, feasible=0.0),
    ]
    exact = [row.schedulers["exact"] for row in rows]
    assert [(one.status, one.bound, one.timed_out, one.seconds) for one in exact] == [
        ("feasible", 48.0, 1, 10.0),
        ("optimal", 80.0, 0, 0.5),
    ]

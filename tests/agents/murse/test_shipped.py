"""What ships for MuRSE beats the rule that it starts from, on instances that it was neither trained nor measured on."""

from __future__ import annotations

import pytest

pytest.importorskip("torch")

from marl_sched.agents.registry import create_scheduler
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import evaluate_scheduler


def test_the_planning_policy_is_shorter_than_the_rule():
    """By 8 percent on small instances of another seed, whose deviation of the mean is 4 with 100 of them."""
    problem = Problem(
        "murse", scale="small", count=100, seed=90003, episodes=1, horizon=1, options={"durations": "deterministic"}
    )
    learned, rule = (
        evaluate_scheduler(problem, create_scheduler(name, "murse")).measures for name in ("murse-full-makespan", "lst")
    )
    assert learned["makespan"].mean() < rule["makespan"].mean()
    assert learned["feasible"].mean() >= rule["feasible"].mean()


@pytest.mark.parametrize(("name", "scale"), [("robognn", "robots-small"), ("schedulenet", "heterogeneous-10-small")])
def test_planners_that_build_steps_solve_more_than_the_rule(name: str, scale: str):
    """One pass, on instances that neither training nor validation nor export has drawn."""
    problem = Problem("murse", scale=scale, count=60, seed=90003, episodes=1, horizon=1)
    learned, rule = (evaluate_scheduler(problem, create_scheduler(one, "murse")).measures for one in (name, "lst"))
    assert learned["feasible"].mean() > rule["feasible"].mean()
    assert learned["makespan"].mean() < rule["makespan"].mean()

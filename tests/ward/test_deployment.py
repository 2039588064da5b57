"""Nurses as agents that know only what they hear, on a network in memory."""

import numpy as np
import pytest

from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.inproc import play
from marl_sched.comms.options import WorldOptions
from marl_sched.problem import Problem


@pytest.mark.parametrize("view", ["full", "local"])
def test_a_deployed_run_equals_the_run_in_process(view):
    problem = Problem("ward", count=1, seed=3, horizon=3, view=view)
    simulator, rule = problem.simulator(), create_scheduler("marginal-cost", "ward")
    rule.start(simulator, np.ones(1, np.bool_))
    turns = 0
    while simulator.acting[0] >= 0:
        simulator.step(rule.decide(simulator))
        turns += 1
    options = WorldOptions(problem=problem, deadline=30.0, ready_timeout=30.0)
    report = play(options, ["marginal-cost"] * int(simulator.n_agents[0])).as_json()
    assert report["M1"] == simulator.objectives()["cost"][0]
    assert len(report["decisions"]) == turns
    assert report["missed_deadlines"] == report["unparsed"] == report["stale"] == 0

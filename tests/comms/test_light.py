"""Agents that carry neither Numba nor PyTorch: what they import, and that they decide as others do."""

from __future__ import annotations

import json
import subprocess
import sys
import uuid

import numpy as np
import pytest

from marl_sched.agents.airme.light_rules import RULES
from marl_sched.agents.light import create_light_scheduler
from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError, UnknownNameError
from marl_sched.light import light_domain
from marl_sched.problem import Problem

pytest.importorskip("onnxruntime", reason="the extra [light] is not installed")
LIGHT = light_domain("airme")
LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 12}
HEAVY = ("torch", "numba", "pettingzoo", "gymnasium", "scipy")

# One agent of a world that is listening; says what it had imported when the run was over.
AGENT = """
import json, sys
from marl_sched.comms.agent import run
from marl_sched.comms.agent_options import AgentOptions
counts = run(AgentOptions(**json.loads(sys.argv[1])))
print(json.dumps({"decisions": counts["decisions"], "modules": sorted(sys.modules)}))
"""


def test_light_rules_choose_as_compiled_ones_do():
    problem = Problem("airme", count=30, seed=4, view=LOCAL)
    simulator, rng = problem.simulator(), np.random.default_rng(1)
    simulator.reset(seed=4, episodes=problem.episode_numbers(list(range(30))))
    compiled = {name: create_scheduler(name, "airme") for name in RULES}
    light = {name: create_light_scheduler(name, LIGHT) for name in RULES}
    served = dict.fromkeys(RULES, 0)
    for _ in range(300):
        _, observation = simulator.observe_acting()
        uniform = rng.random(len(observation["time"]))
        for name, rule in compiled.items():
            chosen = rule.choose(observation, uniform)
            assert (light[name].choose(observation, uniform) == chosen).all(), name
            served[name] += int((chosen > 0).sum())
        simulator.step(compiled["preventive-first"].choose(simulator.observe(simulator.acting), np.zeros(30)))
    assert all(served.values()), served


def test_what_a_light_agent_cannot_decide_by_is_named():
    with pytest.raises(UnknownNameError, match="without Numba 'index'"):
        create_light_scheduler("index", LIGHT)
    with pytest.raises(InvalidFileError, match="policy for airme"):
        create_light_scheduler("murse-local-makespan", LIGHT)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["condition", "airme-local-profit"])
def test_a_light_agent_imports_nothing_that_a_robot_does_not_carry(policy, tmp_path):
    """A world whose one crew is a process that was started by hand."""
    pytest.importorskip("zenoh")
    from marl_sched.comms.transport.endpoints import settle_port

    instance = get_domain("airme").instances("small", 1, 1)[0].as_json()
    instance["n_crews"] = 1
    (tmp_path / "fleet.json").write_text(json.dumps(instance))
    run, endpoint = f"test-{uuid.uuid4().hex[:12]}", settle_port("tcp/127.0.0.1:0")
    problem = Problem("airme", instances=[tmp_path / "fleet.json"], horizon=60, view=LOCAL)
    world = WorldOptions(problem=problem, run=run, listen=endpoint, deadline=30.0, ready_timeout=120.0)
    agent = {"agent": 0, "policy": policy, "run": run, "connect": endpoint, "runtime": "onnx", "join_timeout": 120.0}
    agent["log_format"] = "json"
    command = [sys.executable, "-P", "-c", AGENT, json.dumps(agent)]
    from marl_sched.comms.world import serve

    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        report = serve(world)
        told = json.loads(process.communicate(timeout=60)[0])
    assert report.ending.exit_code == 0
    assert told["decisions"] == len(report.decisions) > 0
    assert "marl_sched.envs.airme.numpy_view" in told["modules"]
    assert not [name for name in told["modules"] if name.partition(".")[0] in HEAVY]


@pytest.mark.slow
def test_a_deployment_of_light_agents_plays_the_run_that_is_played_in_process(in_process):
    pytest.importorskip("zenoh")
    from marl_sched.comms.launcher import deploy

    given = WorldOptions(
        problem=Problem("airme", count=1, horizon=48, view=LOCAL), run=f"test-{uuid.uuid4().hex[:12]}",
        listen="tls/127.0.0.1:0", deadline=30.0, ready_timeout=200.0, standstill=200.0, grace=60.0,
    )  # fmt: skip
    policies = ["random"] * 6 + ["airme-local-profit"]
    report = deploy(
        DeployOptions(world=given, policy="random", agent_policies={"crew_6": policies[6]}, runtime="onnx")
    ).as_json()
    reference = in_process(given, policies)
    assert report["decisions"] == reference["decisions"]
    assert (report["rewards"], report["M1"]) == (reference["rewards"], reference["M1"])

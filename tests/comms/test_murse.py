"""Robots and humans of MuRSE as agents of a deployment: equal to the AEC environment, whatever decides."""

from __future__ import annotations

import pytest

from marl_sched import murse_v0
from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.fork_server import warm_up
from marl_sched.comms.inproc import play
from marl_sched.comms.launcher import deploy
from marl_sched.comms.mind import decider_of
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.replay import replay
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError, UnknownNameError
from marl_sched.problem import Problem

LOCAL = {"kind": "local", "sensing": 6.0, "comm": 2.0}
ONLINE = {"mode": "online", "durations": "stochastic"}


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """What is played here is compiled before: threads that compile would take each other's time."""
    warm_up(options(), ["random", "edf", "lst"])


def options(*, seed=0, horizon=1, view="full", simulator=ONLINE, **changes) -> WorldOptions:
    """A round of a small team; nobody is ever late."""
    problem = Problem("murse", count=1, seed=seed, horizon=horizon, view=view, options=simulator)
    return WorldOptions(**{"problem": problem, "deadline": 60.0, "ready_timeout": 60.0, **changes})


def n_agents(given: WorldOptions) -> int:
    return int(given.simulator().n_agents[0])


def played_in_aec(given: WorldOptions, policies: list[str]) -> list[int]:
    """The actions of observation schedulers that play PettingZoo's environment, in turn."""
    problem = given.problem
    env = murse_v0.env(
        instance=problem.instances[0], scale=problem.scale, view=problem.view, horizon=problem.horizon, split="test",
        **problem.options,
    )  # fmt: skip
    env.reset(seed=problem.seed)
    schedulers = {
        name: create_scheduler(policy, "murse") for name, policy in zip(env.possible_agents, policies, strict=False)
    }
    actions = []
    for agent in env.agent_iter():
        observation, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        simulator = env.unwrapped.simulator
        noise = float(simulator.policy_noise(simulator.acting)[0])
        actions.append(schedulers[agent].act(observation, noise))
        env.step(actions[-1])
    return actions


@pytest.mark.parametrize("view", ["full", LOCAL], ids=["full", "local"])
@pytest.mark.parametrize(
    "seeds",
    [range(2), pytest.param(range(2, 20), marks=pytest.mark.slow)],
    ids=["two seeds", "eighteen more"],
)
def test_run_equals_the_aec_environment(view, seeds):
    for seed in seeds:
        given = options(seed=seed, view=view)
        policies = ["random", "edf", *["random"] * (n_agents(given) - 2)]
        report = play(given, policies)
        assert [decision.action for decision in report.decisions] == played_in_aec(given, policies), seed
        assert report.ending.kind == "complete"


@pytest.mark.parametrize("view", ["full", LOCAL], ids=["full", "local"])
def test_agents_run_the_latest_start_rule_on_what_they_are_told_as_in_the_simulator(in_process, view):
    for seed in range(4):
        given = options(seed=seed, view=view)
        policies = ["lst-local", *["lst-robust-local"] * (n_agents(given) - 1)]
        report = play(given, policies).as_json()
        reference = in_process(given, policies)
        assert (report["decisions"], report["rewards"]) == (reference["decisions"], reference["rewards"]), seed


@pytest.mark.parametrize("policy", ["lst", "lst-robust", "spt"])
@pytest.mark.parametrize("mode", ["online", "plan"])
def test_planners_plan_on_what_they_are_told_as_on_the_simulator(in_process, policy, mode):
    given = options(horizon=2, seed=3, simulator={**ONLINE, "mode": mode})
    policies = [policy] * n_agents(given)
    reference = in_process(given, policies)  # first: it compiles what the threads of the other run would wait for
    report = play(given, policies).as_json()
    assert (report["decisions"], report["rewards"]) == (reference["decisions"], reference["rewards"])
    assert report["M1"] == reference["M1"]
    assert len(report["makespan"]) == report["progress"] == 2


def test_planner_under_a_view_that_hides_is_refused_with_the_reason():
    plant = options(view=LOCAL).plant()
    known = plant.telemetry.local_state(plant.frame, 0)
    for channel, payload in plant.state().changed.items():
        if channel in known.channels:
            known.hear(channel, payload)
    with pytest.raises(InvalidOptionError, match="lst plans for the whole team: expected a view that hides nothing"):
        decider_of("lst", get_domain("murse")).choose(known, 0.5)


def test_scheduler_that_needs_the_noise_and_an_option_that_does_not_exist_are_refused():
    with pytest.raises(InvalidOptionError, match="lst-search needs more than an agent is told"):
        decider_of("lst-search", get_domain("murse"))
    with pytest.raises(UnknownNameError, match="'modus'"):
        options(simulator={"modus": "online"})


@pytest.mark.slow
def test_ten_rounds_of_two_robots_and_two_humans_as_processes_are_replayed_to_their_gantt_chart(tmp_path, in_process):
    pytest.importorskip("matplotlib")
    given = options(horizon=10, seed=two_and_two(), view=LOCAL, listen="tls/127.0.0.1:0", ready_timeout=300.0)
    kept, others = str(tmp_path / "kept"), {"agent_2": "lst-local", "agent_3": "lst-local"}
    report = deploy(DeployOptions(world=given, policy="edf", agent_policies=others, folder=kept)).as_json()
    reference = in_process(given, ["edf", "edf", "lst-local", "lst-local"])
    assert (report["decisions"], report["rewards"]) == (reference["decisions"], reference["rewards"])
    assert report["ending"] == {"kind": "complete", "reason": None, "exit_code": 0}
    assert report["progress"] == len(report["makespan"]) == 10
    again = replay(tmp_path / "kept" / "run.jsonl", tmp_path / "gantt.png").as_json()
    assert (again["decisions"], again["makespan"]) == (report["decisions"], report["makespan"])
    assert (tmp_path / "gantt.png").read_bytes().startswith(b"\x89PNG")


def two_and_two() -> int:
    """The first seed whose team has two robots and two humans."""
    return next(
        seed
        for seed in range(100)
        if (instance := get_domain("murse").instances("small", 1, seed)[0]).n_robots == instance.n_humans == 2
    )

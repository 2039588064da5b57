"""A recurrent policy of a domain from outside: trained, resumed, exported, and deployed as processes with memories."""

import json

import numpy as np
import pytest

LEARN = (
    "env=couriers-deployable", "view=near", "view.reach=2", "policy=lstm", "policy.hidden=16", "policy.units=16",
    "algorithm=gae", "algorithm.instances=8", "algorithm.turns=32", "algorithm.reward_centering=false",
    "algorithm.ppo.minibatch=64", "algorithm.ppo.epochs=4", "algorithm.ppo.learning_rate=5e-3",
    "algorithm.critic.layers=1", "validation.instances=8", "validation.every=10", "save_every=1",
    "updates=10",
)  # fmt: skip
NEAR = {"kind": "near", "reach": 2}


@pytest.fixture
def trained(run, installed, tmp_path):
    """Ten updates in one go, and the same run interrupted in its seventh and resumed."""
    from marl_sched.train.callbacks import Callback
    from marl_sched.train.config import load_config
    from marl_sched.train.run import train

    class Interrupt(Callback):
        """Ends the run when the turns of its seventh update are there, before they are learned from."""

        def on_rollout(self, run, rollout):
            if run.counters.update == 6:
                raise InterruptedError

    whole, halves = tmp_path / "whole", tmp_path / "halves"
    assert run("train", *LEARN, f"run_dir={whole}").code == 0
    with pytest.raises(InterruptedError):
        train(load_config([*LEARN, f"run_dir={halves}"]), [Interrupt()], quiet=True)
    assert run("resume", halves).code == 0
    return whole, halves


@pytest.mark.slow
def test_a_recurrent_policy_is_trained_resumed_exported_and_deployed(trained, run, tmp_path):
    """What is learned does not depend on the interruption; processes with memories play as one process does."""
    whole, halves = trained
    once, twice = _tensors(whole), _tensors(halves)
    assert once.keys() == twice.keys()
    assert all(np.array_equal(once[name], twice[name]) for name in once)
    assert any(name.startswith("optimizer.exp_avg.policy.cell") and once[name].any() for name in once)
    few = ("--instances", 2, "--episodes", 1)
    assert run("export", whole, "mine", "--out", tmp_path, *few).code == 0
    policy = tmp_path / "mine.safetensors"
    assert json.loads((tmp_path / "mine.json").read_text())["sizes"]["architecture"] == "lstm"
    assert _score(policy, "greedy") < 0.9 * _untrained(policy)

    ended = run(
        "deploy", "--env", "couriers-deployable", "--policy", policy, "--view", "near", "--reach", 2, "--seed", 3,
        "--json", tmp_path / "run.json",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    report = json.loads((tmp_path / "run.json").read_text())
    decisions, m1 = _in_one_process(policy, seed=3)
    assert [(said["agent"], said["action"]) for said in report["decisions"]] == decisions
    assert report["M1"] == m1
    assert [agent["memory"]["decisions"] for agent in report["agents"]] == [
        sum(agent["name"] == name for name, _ in decisions) for agent in report["agents"]
    ]


def _tensors(run_dir):
    """Everything that a run has learned and where it stands, name -> array."""
    from safetensors.numpy import load_file

    (path,) = run_dir.glob("checkpoint-*.safetensors")
    best = {f"best.{name}": array for name, array in load_file(run_dir / "policy.safetensors").items()}
    return {**load_file(path), **best}


def _score(policy, mode):
    from marl_sched.agents.registry import load_policy

    return _waiting(load_policy(policy, mode=mode))


def _untrained(policy):
    """A network of the same sizes that has learned nothing: it chooses among all legal actions nearly alike."""
    from marl_sched.agents.policies.checkpoint import load_network
    from marl_sched.agents.policies.network_policy import policy_of

    network, _ = load_network(policy)
    return _waiting(policy_of(network.config.build(network.spec), mode="sample"))


def _waiting(policy):
    from marl_sched.problem import Problem
    from marl_sched.train.evaluation.evaluate import evaluate_scheduler

    problem = Problem("couriers-deployable", count=24, seed=5, view=NEAR)
    return float(evaluate_scheduler(problem, policy).measures["waiting"].mean())


def _in_one_process(policy, seed):
    """Each agent by itself in the AEC API: (agent, action) of every decision, and M1."""
    from marl_sched.agents.recurrent import LocalAgent
    from marl_sched.agents.registry import load_policy
    from marl_sched.envs.api.aec import SchedulingAEC
    from marl_sched.problem import Problem

    problem = Problem("couriers-deployable", count=1, seed=seed, view=NEAR)
    env = SchedulingAEC(
        "couriers-deployable", scale=problem.pad, view=NEAR, split="test", instance=problem.instances[0]
    )
    env.reset(seed=seed)
    agents = {name: LocalAgent(load_policy(policy)) for name in env.agents}
    decisions = []
    for name in env.agent_iter():
        observation, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        action = agents[name].act(observation)
        decisions.append((name, action))
        env.step(action)
    return decisions, float(env.simulator.objectives()["waiting"][0])

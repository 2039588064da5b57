"""Decima and DeepRM from configuration to score: REINFORCE, run, resumption, export, evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from marl_sched.agents import load_policy
from marl_sched.agents.networks.decima import DecimaNetwork
from marl_sched.agents.networks.deeprm import DeepRMNetwork
from marl_sched.agents.networks.network import slots_of
from marl_sched.agents.policies.cards import read_card
from marl_sched.cli.app import run as run_command
from marl_sched.files import read_json, write_json
from marl_sched.problem import Problem
from marl_sched.train.algorithms.step_baseline import StepBaseline
from marl_sched.train.collect import EpisodeCollector
from marl_sched.train.config import load_config
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from marl_sched.train.learner import PolicyGradient
from marl_sched.train.ppo import Ppo
from marl_sched.train.run import resume, train_from_overrides
from tests.train.playing import task

TINY = [
    "algorithm=reinforce", "policy.hidden=4", "algorithm.instances=2", "algorithm.episodes=2", "updates=2",
    "curriculum.start=10", "curriculum.stop=10", "save_every=1", "validation.every=1", "validation.instances=2",
    "validation.length=20",
]  # fmt: skip
EPISODES = 4
LENGTH = 12


@pytest.mark.parametrize("architecture", ["decima", "deeprm"])
def test_an_update_is_a_step_along_the_gradient_of_reinforce(architecture: str):
    """Against autograd of mean(A log pi), with A from rewards-to-go less their mean, all in plain loops."""
    collector = EpisodeCollector(task(rows=8, episodes=EPISODES, turns=None, view={"kind": "full"}))
    env = collector.env
    spec = env.simulator.graph
    torch.manual_seed(0)
    if architecture == "decima":
        network = DecimaNetwork(spec, hidden=8)
    else:
        network = DeepRMNetwork(spec, slots=slots_of(spec, env.simulator.arrays), hidden=8)
    rollout = collector.collect(network, LENGTH)
    config = load_config(["algorithm=reinforce", "algorithm.ppo.max_grad_norm=1e9"]).algorithm.ppo
    expected = torch.autograd.grad(plain_loss(network, rollout), list(network.parameters()))
    before = [parameter.detach().clone() for parameter in network.parameters()]
    learner = PolicyGradient(Ppo(network, None, config), StepBaseline(discount=0.99, episodes=EPISODES))
    learner.learn(rollout, 0.0, np.random.default_rng(0))
    largest = max(gradient.abs().max() for gradient in expected)
    # Adam divides by |gradient| + 1e-8: a step is within 1 % of the learning rate for gradients above 1e-6.
    assert 0.05 * largest > 1e-6
    for parameter, gradient, old in zip(network.parameters(), expected, before, strict=True):
        assert torch.allclose(parameter.grad, gradient, rtol=1e-3, atol=1e-4 * float(largest))
        # Adam's first step is the learning rate along the sign of the gradient: one step was taken, no more.
        moved = gradient.abs() > 0.05 * largest
        assert torch.allclose((parameter - old)[moved], -config.learning_rate * gradient[moved].sign(), rtol=1e-2)


def plain_loss(network: torch.nn.Module, rollout) -> torch.Tensor:
    turns, rows = rollout.actions.shape
    to_go = np.zeros((LENGTH + 1, rows))
    hourly = np.zeros((LENGTH, rows))
    for t in range(turns):
        for b in range(rows):
            hour, passed = int(rollout.times[t, b]), int(rollout.elapsed[t, b])
            for later in range(hour, min(hour + passed, LENGTH)):
                if rollout.valid[t, b]:
                    hourly[later, b] += float(rollout.rewards[t, b]) / passed
    for hour in reversed(range(LENGTH)):
        to_go[hour] = hourly[hour] + 0.99 * to_go[hour + 1]
    taken = [(t, b) for t in range(turns) for b in range(rows) if rollout.valid[t, b]]
    advantages = []
    for t, b in taken:
        hour, instance = int(rollout.times[t, b]), b // EPISODES
        baseline = to_go[hour, instance * EPISODES : (instance + 1) * EPISODES].mean()
        advantages.append(to_go[hour, b] - baseline)
    advantages = (np.array(advantages) - np.mean(advantages)) / np.std(advantages)
    total = torch.zeros(())
    for (t, b), advantage in zip(taken, advantages, strict=True):
        seen = rollout.data[b : b + 1, t]
        total = total - float(advantage) * network(seen).log_softmax(-1)[0, rollout.actions[t, b]]
    return total / len(taken)


@pytest.mark.parametrize("architecture", ["decima", "deeprm"])
def test_a_run_is_trained_resumed_exported_and_evaluated(
    architecture: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    overrides = [f"policy={architecture}", *TINY]
    whole = train_from_overrides([*overrides, f"run_dir={tmp_path / 'whole'}"], quiet=True)
    halved = train_from_overrides([*overrides, "updates=1", f"run_dir={tmp_path / 'halved'}"], quiet=True)
    config = read_json(halved / "config.json")
    config["config"]["updates"] = 2
    write_json(halved / "config.json", config)
    resume(halved, quiet=True)
    assert (whole / "policy.safetensors").read_bytes() == (halved / "policy.safetensors").read_bytes()

    few = ["--instances", "1", "--episodes", "1", "--seed", "5"]
    assert run_command(["export", str(whole), "mine", "--out", str(tmp_path), "--length", "10", *few]) == 0
    card = read_card(tmp_path / "mine.json")
    scales = ["small"] if architecture == "deeprm" else ["small", "medium", "large"]
    assert [name for name in card.scores if name != "validation"] == scales
    evaluate = ["evaluate", "--schedulers", str(tmp_path / "mine.safetensors"), "--hours", "10", *few]
    assert run_command([*evaluate, "--scale", "small", "--json", str(tmp_path / "scores.json")]) == 0
    row = read_json(tmp_path / "scores.json")["schedulers"][str(tmp_path / "mine.safetensors")]
    assert row["M1"]["mean"] == pytest.approx(card.scores["small"]["M1"])
    capsys.readouterr()
    ended = run_command([*evaluate, "--scale", "medium"])
    if architecture == "deeprm":
        assert ended == 2
        assert "slots 37 plane, 8 crew cannot read one with 73 plane, 16 crew" in capsys.readouterr().err
    else:
        assert ended == 0


def test_reinforce_takes_one_step_an_update_on_all_turns():
    algorithm = load_config(["algorithm=reinforce"]).algorithm
    ppo = algorithm.ppo
    assert (algorithm.episodes, ppo.epochs, ppo.min_keep_prob, ppo.entropy, ppo.final_entropy) == (8, 1, 1.0, 0.0, 0.0)
    assert ppo.minibatch > 10**6


def test_policies_have_the_dissertations_sizes():
    decima, deeprm = (load_config([f"policy={name}"]).policy for name in ("decima", "deeprm"))
    assert (decima.hidden, decima.layers) == (64, 3)
    assert (deeprm.hidden, deeprm.layers) == (64, 4)


def test_a_policy_is_played_as_it_was_validated(tmp_path: Path):
    overrides = ["policy=deeprm", *TINY, "updates=1", "validation.mode=sample"]
    directory = train_from_overrides([*overrides, f"run_dir={tmp_path}"], quiet=True)
    path = directory / "policy.safetensors"
    assert read_card(directory / "policy.json").mode == "sample"
    assert load_policy(path).mode == "sample"
    assert load_policy(path, mode="greedy").mode == "greedy"
    seed = load_config(overrides).validation.seed
    problem = Problem("airme", scale="small", count=2, episodes=1, seed=seed, split="validation", horizon=20)
    scores = evaluate_scheduler(problem, load_policy(path)).measures["profit"]
    assert read_card(directory / "policy.json").scores["validation"]["M1"] == pytest.approx(scores.mean())
    greedy = evaluate_scheduler(problem, load_policy(path, mode="greedy")).measures["profit"]
    assert greedy.mean() != pytest.approx(scores.mean())

"""Learning what choices cost on average along a policy's own sequences."""

from __future__ import annotations

import numpy as np
import torch

from marl_sched.train.algorithms.choice_costs import excess_of
from marl_sched.train.config import RunRecord, load_config
from marl_sched.train.parts import build


def test_excess_costs_are_shares_above_the_least():
    """Costs 10, 12 and 45 beside an impossible one; a row with one possibility is no choice, nor is one with none."""
    inf = np.inf
    costs = np.array([[10.0, 12.0, 45.0, inf], [inf, 7.0, inf, inf], [inf, inf, inf, inf]])
    excess, there = excess_of(costs)
    torch.testing.assert_close(excess[0], torch.tensor([0.0, 0.2, 3.5, inf]))
    assert there.tolist() == [True, False, False]
    assert float(excess[1, 1]) == 0.0
    assert bool(torch.isinf(excess[2]).all())


def test_learning_the_costs_of_a_few_instances_lowers_the_regret_on_them():
    """The same four instances again and again, with a network that begins without the rule."""
    overrides = [
        "env=murse", "policy=hybridnet", "algorithm=choice_costs", "curriculum=rounds", "env.scales=[small]",
        "policy.width=4", "policy.heads=2", "policy.hidden=16", "policy.edge_width=4", "policy.residual=none",
        "algorithm.instances=4", "algorithm.epochs=10", "algorithm.minibatches=1", "algorithm.learning_rate=0.01",
        "algorithm.criterion=expected_cost", "device=cpu", "+env.options.durations=deterministic",
    ]  # fmt: skip
    parts = build(RunRecord(config=load_config(overrides), overrides=[], revision=""))
    regrets = []
    for _ in range(5):
        parts.collector.restore({"updates": np.array([0])})
        experience = parts.collector.collect(parts.learner.policy, 1)
        regrets.append(parts.learner.learn(experience, 0.0, np.random.default_rng(0))["regret"])
    assert regrets[-1] < 0.7 * regrets[0]

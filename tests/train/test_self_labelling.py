"""Self-labelling: whose choices become labels, by hand, and that learning makes them likelier."""

from __future__ import annotations

import numpy as np
import torch

from marl_sched.train.algorithms.self_labelling import best_episodes
from marl_sched.train.config import RunRecord, load_config
from marl_sched.train.parts import build

TINY = [
    "env=murse", "policy=hetgat_residual", "algorithm=self_labelling", "curriculum.start=1", "curriculum.stop=1",
    "env.scales=[small]", "+env.options.durations=deterministic", "policy.width=4", "policy.heads=2",
    "policy.hidden=16", "algorithm.instances=4", "algorithm.episodes=6", "validation.every=2", "validation.instances=2",
    "validation.length=1", "save_every=2", "threads=1", "device=cpu",
]  # fmt: skip


def test_the_first_episode_of_the_largest_return_is_the_label_and_equal_ones_teach_nothing():
    returns = torch.tensor([[-3.0, -1.0, -1.0], [-2.0, -2.0, -2.0]])
    assert best_episodes(returns).tolist() == [[False, True, False], [False, False, False]]


def test_the_best_episodes_become_likelier():
    words = [*TINY, "algorithm.epochs=4", "algorithm.learning_rate=1e-3", "algorithm.min_keep_prob=1.0"]
    parts = build(RunRecord(config=load_config(words), overrides=words, revision=""))
    rollout = parts.collector.collect(parts.learner.policy, 1)
    best = best_episodes(torch.where(rollout.valid, rollout.rewards, 0.0).sum(0).view(4, 6)).flatten()
    before = rollout.log_probs[rollout.valid & best].mean()
    parts.learner.learn(rollout, 0.0, np.random.default_rng(0))
    with torch.no_grad():
        logits = (
            parts.learner.policy(rollout.data.exclude("next").flatten(0, 1))
            .log_softmax(-1)
            .view(*rollout.data.shape, -1)
        )
    after = logits.transpose(0, 1).gather(2, rollout.actions[..., None]).squeeze(2)[rollout.valid & best].mean()
    assert after > before

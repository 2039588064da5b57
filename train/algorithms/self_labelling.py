"""Learning from the best of one's own samples (self-labelling; Corsini et al. 2024, arXiv 2401.11849).

Of the episodes that the policy plays of an instance, the one of the largest return becomes the label: the policy learns
its choices by cross-entropy. Neither a teacher nor a critic is needed, and no reward has to be scaled. Instances whose
episodes all have the same return teach nothing and are left out.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import torch
from msgspec import Meta
from tensordict import TensorDict
from torch import Tensor

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.train.algorithms.base import NAME, Setup
from marl_sched.train.algorithms.supervised import SupervisedConfig, SupervisedLearner
from marl_sched.train.bounds import Count
from marl_sched.train.collect import Collector, EpisodeCollector, Rollout
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import importance_subsample


class SelfLabellingConfig(SupervisedConfig, frozen=True, kw_only=True, tag_field=NAME, tag="self_labelling"):
    """The best of `episodes` episodes of each instance; the learning rate changes linearly."""

    instances: Count
    episodes: Annotated[int, Meta(ge=2)]

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig."""
        collector = EpisodeCollector(setup.whole_episodes(rows=self.instances * self.episodes, episodes=self.episodes))
        return collector, SelfLabelling(setup.policy(collector.env), self)


class SelfLabelling(SupervisedLearner):
    """Learns the best of a policy's own episodes.

    Args:
        policy: observation -> logits (N, n_actions).
        config: see SelfLabellingConfig.
    """

    figures = ("entropy",)

    def __init__(self, policy: PolicyNetwork, config: SelfLabellingConfig) -> None:
        super().__init__(policy, config)
        self._config = config

    def learn(self, rollout: Rollout, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Take gradient steps on the turns of the best episodes that are kept; none where no episode is best."""
        config = self._config
        returns = torch.where(rollout.valid, rollout.rewards, 0.0).sum(0).view(-1, config.episodes)
        best = best_episodes(returns)
        report = {
            "gain": float((returns.max(1).values - returns.mean(1)).mean()),
            "taught": float(best.any(1).double().mean()),
        }
        labelled = rollout.valid & best.flatten()
        if not labelled.any():
            return report
        samples, names, (turn, row) = importance_subsample(self.policy, rollout, labelled, config.min_keep_prob, rng)
        samples["label"] = (names == rollout.actions[turn, row][:, None]).int().argmax(1)
        return report | self.fit(samples, progress, rng)

    def _losses(self, batch: TensorDict, log_probs: Tensor, progress: float) -> Tensor:
        return -log_probs.gather(1, batch["label"][:, None]).squeeze(1)

    def _figures(self, batch: TensorDict, log_probs: Tensor) -> list[Tensor]:
        return [-(log_probs.exp() * log_probs).sum(-1)]


def best_episodes(returns: Tensor) -> Tensor:
    """Which episodes are labels, bool, of returns (I, E): the first of the largest, none where all are the same."""
    best = torch.zeros_like(returns, dtype=torch.bool)
    best.scatter_(1, returns.argmax(1, keepdim=True), value=True)
    return best & (returns.max(1, keepdim=True).values > returns.min(1, keepdim=True).values)

"""Learning from the best of one's own samples (self-labelling; Corsini et al. 2024, arXiv 2401.11849).

Of the episodes that the policy plays of an instance, the one of the largest return becomes the label: the policy learns
its choices by cross-entropy. Neither a teacher nor a critic is needed, and no reward has to be scaled. Instances whose
episodes all have the same return teach nothing and are left out.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import torch
from msgspec import Meta, Struct
from tensordict import TensorDict
from torch import Tensor, nn

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.train.algorithms.base import NAME, AlgorithmConfig, Setup
from marl_sched.train.bounds import Count, NonNegative, Positive
from marl_sched.train.collect import Collector, EpisodeCollector, Rollout
from marl_sched.train.device import device_of
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between, importance_subsample, means
from marl_sched.train.sequences import logits_of, minibatches


class SelfLabellingConfig(
    AlgorithmConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="self_labelling"
):
    """The best of `episodes` episodes of each instance; the learning rate changes linearly."""

    instances: Count
    episodes: Annotated[int, Meta(ge=2)]
    epochs: Count
    minibatch: Count
    learning_rate: Positive
    final_learning_rate: NonNegative
    max_grad_norm: Positive
    min_keep_prob: Annotated[float, Meta(gt=0, le=1)]

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig."""
        collector = EpisodeCollector(setup.whole_episodes(rows=self.instances * self.episodes, episodes=self.episodes))
        return collector, SelfLabelling(setup.policy(collector.env), self)


class SelfLabelling:
    """Learns the best of a policy's own episodes.

    Args:
        policy: observation -> logits (N, n_actions).
        config: see SelfLabellingConfig.
    """

    def __init__(self, policy: PolicyNetwork, config: SelfLabellingConfig) -> None:
        self.policy, self._config = policy, config
        self.modules: dict[str, nn.Module] = {"policy": policy}
        self.optimizer = torch.optim.Adam(policy.parameters(), fused=True)

    def learn(self, rollout: Rollout, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Take gradient steps on the turns of the best episodes that are kept; none where no episode is best."""
        config, device = self._config, device_of(self.policy)
        rate = between(config.learning_rate, config.final_learning_rate, progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
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
        on_device = samples.to(device)
        reports = [
            self._step(on_device[indices.to(device)])
            for indices in minibatches(samples, config.minibatch, config.epochs, rng)
        ]
        return report | dict(zip(("policy_loss", "entropy", "gradient"), means(reports), strict=True))

    def _step(self, batch: TensorDict) -> Tensor:
        share = batch["weight"] / batch["weight"].sum()
        log_probs = logits_of(self.policy, batch).log_softmax(-1)
        loss = -(share @ log_probs.gather(1, batch["label"][:, None]).squeeze(1))
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self._config.max_grad_norm)
        self.optimizer.step()
        with torch.no_grad():
            entropy = -(share @ (log_probs.exp() * log_probs).sum(-1))
            return torch.stack([loss.detach(), entropy, norm])

    def state(self) -> dict[str, float | None]:
        """Nothing."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""


def best_episodes(returns: Tensor) -> Tensor:
    """Which episodes are labels, bool, of returns (I, E): the first of the largest, none where all are the same."""
    best = torch.zeros_like(returns, dtype=torch.bool)
    best.scatter_(1, returns.argmax(1, keepdim=True), value=True)
    return best & (returns.max(1, keepdim=True).values > returns.min(1, keepdim=True).values)

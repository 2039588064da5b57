"""Learning choices that were labelled: what imitation of teachers and of one's own best episodes share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, ClassVar

import numpy as np
import torch
from msgspec import Meta, Struct
from tensordict import TensorDict
from torch import Tensor, nn

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.train.algorithms.base import AlgorithmConfig
from marl_sched.train.bounds import Count, NonNegative, Positive
from marl_sched.train.device import device_of
from marl_sched.train.ppo import between, means
from marl_sched.train.sequences import logits_of, minibatches


class SupervisedConfig(AlgorithmConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the steps: passes over the samples, samples a step, the ends of the learning rate, clipping."""

    epochs: Count
    minibatch: Count
    learning_rate: Positive
    final_learning_rate: NonNegative
    max_grad_norm: Positive
    min_keep_prob: Annotated[float, Meta(gt=0, le=1)]


class SupervisedLearner(ABC):
    """Takes steps of Adam on labelled samples; the learning rate changes linearly over the run.

    Attributes:
        figures: names of what `_figures` gives, beside `policy_loss` and `gradient`.
    """

    figures: ClassVar[tuple[str, ...]] = ()

    def __init__(self, policy: PolicyNetwork, settings: SupervisedConfig) -> None:
        self.policy, self._settings = policy, settings
        self.modules: dict[str, nn.Module] = {"policy": policy}
        self.optimizer = torch.optim.Adam(policy.parameters(), fused=True)

    def fit(self, samples: TensorDict, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Go over samples, which have a `weight` each; means of loss, figures and gradient norm over the steps."""
        settings, device = self._settings, device_of(self.policy)
        for group in self.optimizer.param_groups:
            group["lr"] = between(settings.learning_rate, settings.final_learning_rate, progress)
        on_device = samples.to(device)
        reports = [
            self._step(on_device[indices.to(device)], progress)
            for indices in minibatches(samples, settings.minibatch, settings.epochs, rng)
        ]
        return dict(zip(("policy_loss", *self.figures, "gradient"), means(reports), strict=True))

    def _step(self, batch: TensorDict, progress: float) -> Tensor:
        share = batch["weight"] / batch["weight"].sum()
        log_probs = logits_of(self.policy, batch).log_softmax(-1)
        loss = share @ self._losses(batch, log_probs, progress)
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self._settings.max_grad_norm)
        self.optimizer.step()
        with torch.no_grad():
            figures = [share @ figure for figure in self._figures(batch, log_probs)]
            return torch.stack([loss.detach(), *figures, norm])

    @abstractmethod
    def _losses(self, batch: TensorDict, log_probs: Tensor, progress: float) -> Tensor:
        """The loss of each sample, (N,), from the policy's log-probabilities (N, n_actions)."""

    def _figures(self, batch: TensorDict, log_probs: Tensor) -> list[Tensor]:
        """What is told of each sample, (N,) each, by the names of `figures`."""
        return []

    def state(self) -> dict[str, float | None]:
        """Nothing, beside modules and optimizer."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""

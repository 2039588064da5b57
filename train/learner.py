"""What learns from rollouts. The training loop knows no more of an algorithm than this."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.errors import InvalidOptionError
from marl_sched.train.collect import Rollout
from marl_sched.train.estimators import Estimator
from marl_sched.train.ppo import Ppo, samples_of


class Learner(Protocol):
    """A policy and whatever else is learned with it.

    Attributes:
        policy: what plays.
        modules: everything with parameters, the policy among them, by name.
        optimizer: of all of them.
    """

    policy: PolicyNetwork
    modules: dict[str, nn.Module]
    optimizer: torch.optim.Adam

    def learn(self, rollout: Any, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Learn from what the algorithm's own collector gave, such as a Rollout; what is logged of it, by name.

        `progress` in [0, 1] is how far the run has come, `rng` picks and orders samples.
        """

    def state(self) -> dict[str, float | None]:
        """What a resumed run needs beside modules and optimizer, as JSON."""

    def restore(self, state: dict[str, float | None]) -> None:
        """Go on from a saved state."""


class PolicyGradient:
    """PPO on the advantages of an estimator."""

    def __init__(self, ppo: Ppo, estimator: Estimator) -> None:
        self._ppo, self._estimator = ppo, estimator
        self.policy, self.modules, self.optimizer = ppo.policy, ppo.modules, ppo.optimizer

    def learn(self, rollout: Rollout, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Estimate advantages, then optimise the clipped surrogate.

        Raises InvalidOptionError if no turn of the rollout can be learned from, as where a segment is too short for
        an agent to have two turns of its own (IPPO).
        """
        estimate = self._estimator.estimate(rollout)
        if not estimate.loss_mask.any():
            raise InvalidOptionError(
                f"algorithm.turns: expected a segment in which turns can be told from what follows them, got one of "
                f"{rollout.turns} turns of which none can"
            )
        config = self._ppo.config
        samples = samples_of(self.policy, rollout, estimate, config.min_keep_prob, rng, config.bptt)
        report = self._ppo.update(samples, progress, rng)
        return {**asdict(report), "explained_variance": estimate.explained_variance}

    def state(self) -> dict[str, float | None]:
        """The estimator's."""
        return self._estimator.state()

    def restore(self, state: dict[str, float | None]) -> None:
        """The estimator's."""
        self._estimator.restore(state)

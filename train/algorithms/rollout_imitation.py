"""Imitation learning from a scheduler that works out what every choice costs.

The policy that learns also plays, so that it meets its own mistakes (DAgger; Ross et al. 2011). In every state that it
comes to, the teacher says what each choice costs the team if it goes on by the teacher's rule. An excess cost is its
share above the least one. By the criterion `cross_entropy` the policy learns the distribution
softmax(-excess / temperature) over legal actions: choices of the same cost are all right.

What a roll-out costs depends on details that no network can foresee, so that the likeliest best choice need not be the
one of the least cost on average. The criterion `expected_cost` minimises that, sum over a of pi(a) excess(a) less
temperature x entropy (AggreVaTeD; Sun et al. 2017).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.registry import create_scheduler
from marl_sched.train.algorithms.base import NAME, Setup
from marl_sched.train.algorithms.imitation import cross_entropy, expected_advantage
from marl_sched.train.algorithms.supervised import SupervisedConfig, SupervisedLearner
from marl_sched.train.bounds import Count, Positive
from marl_sched.train.collect import Collector, Rollout
from marl_sched.train.environment import COSTS
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between, importance_subsample

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

WORST = 1.0
"""The excess cost that a choice counts with at most, except by cross-entropy."""


class RolloutImitationConfig(SupervisedConfig, frozen=True, kw_only=True, tag_field=NAME, tag="rollout_imitation"):
    """Choices whose costs a teacher works out; temperature and learning rate change linearly.

    Rows play on from update to update, `turns` turns each, with the policy that learns.
    """

    instances: Count
    turns: Count
    teacher: str
    criterion: Literal["cross_entropy", "expected_cost"]
    temperature: Positive
    final_temperature: Positive

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig; raises InvalidOptionError for a scheduler that cannot teach."""
        collector = setup.segments(rows=self.instances, turns=self.turns, central=False, teacher=self.teacher)
        return collector, RolloutImitation(setup.policy(collector.env), self)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The teacher's."""
        teacher = create_scheduler(self.teacher, config.env.name)
        known = f" ({teacher.privileged_info})" if teacher.privileged_info else ""
        return [f"imitation of {teacher.name}{known}"]


class RolloutImitation(SupervisedLearner):
    """Learns what choices cost least.

    Args:
        policy: observation -> logits (N, n_actions).
        config: see RolloutImitationConfig.
    """

    figures = ("regret", "entropy")

    def __init__(self, policy: PolicyNetwork, config: RolloutImitationConfig) -> None:
        super().__init__(policy, config)
        self._config = config

    def learn(self, rollout: Rollout, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Take gradient steps on the turns that are kept."""
        return self.fit(self._samples(rollout, rng), progress, rng)

    def _samples(self, rollout: Rollout, rng: np.random.Generator) -> TensorDict:
        samples, names, (turn, row) = importance_subsample(
            self.policy, rollout, rollout.valid, self._config.min_keep_prob, rng
        )
        samples["excess"] = excess_costs(rollout.data[COSTS][row, turn]).gather(1, names)
        return samples

    def _losses(self, batch: TensorDict, log_probs: Tensor, progress: float) -> Tensor:
        temperature = between(self._config.temperature, self._config.final_temperature, progress)
        if self._config.criterion == "cross_entropy":
            return cross_entropy(log_probs, (-batch["excess"] / temperature).softmax(-1))
        return -expected_advantage(log_probs, -batch["excess"].clamp(max=WORST), temperature)

    def _figures(self, batch: TensorDict, log_probs: Tensor) -> list[Tensor]:
        probs = log_probs.exp()
        return [(probs * batch["excess"].clamp(max=WORST)).sum(-1), cross_entropy(log_probs, probs)]


def excess_costs(costs: Tensor) -> Tensor:
    """Costs, float64 (N, n_actions), as shares above the least of each row, float32; inf stays inf.

    Where all are inf, as in a state in which the agent can only wait for nothing, action 0 has the least.
    """
    costs = torch.where(torch.isfinite(costs).any(1, keepdim=True), costs, _only_waiting(costs))
    least = costs.min(1, keepdim=True).values
    return ((costs - least) / least.clamp(min=1.0)).float()


def _only_waiting(costs: Tensor) -> Tensor:
    waiting = torch.full_like(costs, torch.inf)
    waiting[:, 0] = 1.0
    return waiting

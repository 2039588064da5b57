"""PPO with a state-based value function, against which figure 6.3 holds the step-based baseline (section 6.5.4).

Whole episodes are played as in algorithm 5. The baseline is what a critic makes of the state node's output and
of the time left in the episode, which tells how much there is still to earn. It is a network of its own and
shares no layers with the policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from msgspec import Struct
from torch import Tensor, nn

from marl_sched.agents.networks.hetgat.network import HetGATConfig, HetGATCritic
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.graph import GraphSpec
from marl_sched.train.advantages import returns_by_time
from marl_sched.train.algorithms.base import NAME, AlgorithmConfig, Setup
from marl_sched.train.bounds import Count, Share
from marl_sched.train.collect import Collector, EpisodeCollector, Rollout
from marl_sched.train.device import pick_device
from marl_sched.train.estimators import TIME_LEFT, Estimate, explained_variance, values_of
from marl_sched.train.learner import Learner, PolicyGradient
from marl_sched.train.ppo import Ppo, PpoConfig

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

_UNIT = 100.0  # of the time left and of values, so that a network meets numbers around 1


class StateValueConfig(
    AlgorithmConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="state_value"
):
    """Whole episodes as `step_baseline` plays them, with a critic on the state node as baseline (section 6.5.4)."""

    instances: Count
    episodes: Count
    discount: Share
    critic: HetGATConfig
    ppo: PpoConfig

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig."""
        collector = TimedEpisodes(setup.whole_episodes(rows=self.instances * self.episodes, episodes=self.episodes))
        sizes = self.critic
        critic = StateValue(collector.env.simulator.graph, width=sizes.width, heads=sizes.heads, layers=sizes.layers)
        critic = critic.to(pick_device(setup.config.device))
        estimator = StateValueBaseline(critic, discount=self.discount)
        learner = PolicyGradient(Ppo(setup.policy(collector.env), critic, self.ppo), estimator)
        return collector, learner

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The critic's."""
        return ["a critic that is told the time left"]


class StateValue(nn.Module):
    """A value from the state node's output alone and the time left.

    Args:
        spec: the metagraph.
        width, heads, layers: sizes of the encoder.
    """

    def __init__(self, spec: GraphSpec, *, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.critic = HetGATCritic(spec, width=width, heads=heads, layers=layers, extra=1, summed=())

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Values (B,) from an observation's tensors and, named TIME_LEFT, float32 (B,) in simulated time."""
        return _UNIT * self.critic(observation, observation[TIME_LEFT][:, None] / _UNIT)


class TimedEpisodes(EpisodeCollector):
    """Whole episodes in which the critic, besides what the acting agent sees, is told the time left."""

    def collect(self, policy: PolicyNetwork, length: int) -> Rollout:
        """See EpisodeCollector."""
        rollout = super().collect(policy, length)
        for states in (rollout.data, rollout.data["next"]):
            states[TIME_LEFT] = (length - states["progress"]).float()
        return rollout


class StateValueBaseline:
    """Advantages are rewards-to-go less the critic's value; the critic learns the rewards-to-go."""

    def __init__(self, critic: StateValue, *, discount: float) -> None:
        self._critic, self._discount = critic, discount

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages and value targets."""
        loss_mask, times = rollout.valid, rollout.times
        returns = returns_by_time(
            rollout.rewards, rollout.elapsed, times, loss_mask, discount=self._discount, length=rollout.horizon
        )
        targets = torch.where(loss_mask, returns.gather(0, torch.where(loss_mask, times, 0)), 0.0)
        values = values_of(self._critic, rollout)[0]
        advantages = torch.where(loss_mask, targets - values, 0.0)
        return Estimate(advantages, targets, explained_variance(targets, values, loss_mask), loss_mask)

    def state(self) -> dict[str, float | None]:
        """Nothing."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""

"""PPO with a critic: generalised advantages of the team (MAPPO) or of each agent by itself (IPPO)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct
from torch import Tensor, nn

from marl_sched.agents.networks.hetgat.network import HetGATConfig
from marl_sched.train.advantages import generalised_advantages, own_turn_advantages
from marl_sched.train.algorithms.base import NAME, AlgorithmConfig, Setup
from marl_sched.train.bounds import Count, Share
from marl_sched.train.collect import Collector, Rollout
from marl_sched.train.estimators import Estimate, explained_variance, values_of
from marl_sched.train.learner import Learner, PolicyGradient
from marl_sched.train.ppo import Ppo, PpoConfig

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

_RATE_STEP = 0.2  # of the exponential average of the reward rate


class _CriticConfig(AlgorithmConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Generalised advantages from a critic; rows play on from update to update, `turns` turns each."""

    instances: Count
    turns: Count
    discount: Share
    gae_lambda: Share
    reward_centering: bool
    critic: HetGATConfig
    ppo: PpoConfig

    def _build(self, setup: Setup, estimator: type[CriticEstimator], *, central: bool) -> tuple[Collector, Learner]:
        collector = setup.segments(rows=self.instances, turns=self.turns, central=central)
        critic = setup.critic(collector.env, self.critic)
        credit = estimator(
            critic,
            discount=self.discount,
            gae_lambda=self.gae_lambda,
            reward_centering=self.reward_centering,
        )
        return collector, PolicyGradient(Ppo(setup.policy(collector.env), critic, self.ppo), credit)


class GaeConfig(_CriticConfig, frozen=True, tag_field=NAME, tag="gae"):
    """Generalised advantages along the team's turns, with a critic on the full graph."""

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig."""
        return self._build(setup, CriticEstimator, central=setup.hides)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The critic's, where agents see less."""
        return ["a critic on the full graph"] if config.make_view().hides else []


class IppoConfig(_CriticConfig, frozen=True, tag_field=NAME, tag="ippo"):
    """Generalised advantages along each agent's own turns, with a critic on what the agent sees."""

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig."""
        return self._build(setup, OwnTurns, central=False)


class CriticEstimator:
    """Generalised advantages from a critic that is given the full graph.

    The average reward rate is subtracted from rewards ("reward centring"; Naik et al. 2024), so that values
    say how much better than usual a state is, a few units, and not what a hundred hours are worth. In a
    problem whose episodes end by themselves that would change what is best; there `reward_centering` must be False.
    """

    def __init__(self, critic: nn.Module, *, discount: float, gae_lambda: float, reward_centering: bool) -> None:
        self._critic, self._discount, self._gae_lambda, self._reward_centering = (
            critic,
            discount,
            gae_lambda,
            reward_centering,
        )
        self._rate: float | None = None

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages and value targets."""
        rate = 0.0
        if self._reward_centering:
            seen = rollout.reward_rate
            rate = seen if self._rate is None else self._rate + _RATE_STEP * (seen - self._rate)
            self._rate = rate
        values, next_values = values_of(self._critic, rollout)
        rewards = rollout.rewards - rate * rollout.elapsed
        advantages, targets, loss_mask = self._credit(rollout, rewards, values, next_values)
        return Estimate(advantages, targets, explained_variance(targets, values, loss_mask), loss_mask)

    def _credit(
        self, rollout: Rollout, rewards: Tensor, values: Tensor, next_values: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Advantages, value targets and the turns to learn from, (T, B) each."""
        advantages, targets = generalised_advantages(
            rewards,
            rollout.elapsed,
            values,
            next_values,
            rollout.boundary,
            rollout.terminated,
            discount=self._discount,
            gae_lambda=self._gae_lambda,
        )
        return advantages, targets, rollout.valid

    def state(self) -> dict[str, float | None]:
        """The reward rate."""
        return {"reward_rate": self._rate}

    def restore(self, state: dict[str, float | None]) -> None:
        """The reward rate."""
        self._rate = state["reward_rate"]


class OwnTurns(CriticEstimator):
    """Independent learners (IPPO): generalised advantages along each agent's own turns (`own_turn_advantages`).

    For rollouts without a central graph, in which the critic sees what the acting agent does.
    """

    def _credit(
        self, rollout: Rollout, rewards: Tensor, values: Tensor, next_values: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        return own_turn_advantages(
            rewards,
            rollout.elapsed,
            values,
            next_values,
            rollout.agents,
            rollout.column("next", "acting"),
            rollout.boundary,
            rollout.terminated,
            discount=self._discount,
            gae_lambda=self._gae_lambda,
        )

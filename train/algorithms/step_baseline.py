"""The dissertation's algorithm 5: PPO with the mean return of an instance's episodes at the same time as baseline."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from marl_sched.train.advantages import step_baseline_advantages
from marl_sched.train.algorithms.base import NAME, AlgorithmConfig, Setup
from marl_sched.train.bounds import Count, Share
from marl_sched.train.collect import Collector, EpisodeCollector, Rollout
from marl_sched.train.estimators import Estimate
from marl_sched.train.learner import Learner, PolicyGradient
from marl_sched.train.ppo import Ppo, PpoConfig


class StepBaselineConfig(
    AlgorithmConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="step_baseline"
):
    """Advantages from `episodes` episodes of the same instance (algorithm 5); whole episodes every update."""

    instances: Count
    episodes: Annotated[int, Meta(ge=2)]
    discount: Share
    ppo: PpoConfig

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig."""
        collector = EpisodeCollector(setup.whole_episodes(rows=self.instances * self.episodes, episodes=self.episodes))
        estimator = StepBaseline(discount=self.discount, episodes=self.episodes)
        learner = PolicyGradient(Ppo(setup.policy(collector.env), None, self.ppo), estimator)
        return collector, learner


class StepBaseline:
    """The dissertation's baseline: the mean return of all episodes of the instance, its own too, at the same time."""

    def __init__(self, *, discount: float, episodes: int) -> None:
        self._discount, self._episodes = discount, episodes

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages; there is no critic."""
        advantages = step_baseline_advantages(
            rollout.rewards,
            rollout.elapsed,
            rollout.times,
            rollout.valid,
            discount=self._discount,
            length=rollout.horizon,
            episodes=self._episodes,
        )
        return Estimate(advantages, None, 0.0, rollout.valid)

    def state(self) -> dict[str, float | None]:
        """Nothing."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""

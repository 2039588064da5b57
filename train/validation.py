"""Which of a run's policies is best: play on fixed instances with the same noise every time."""

from __future__ import annotations

from marl_sched.agents.learned.network import PolicyNetwork
from marl_sched.agents.learned.policy import NetworkPolicy
from marl_sched.domain import Domain, get_domain
from marl_sched.train.config import TrainConfig
from marl_sched.train.evaluate import Settings, evaluate_scheduler


class Validation:
    """The mean of the run's objective that a network reaches on the validation instances."""

    def __init__(self, config: TrainConfig) -> None:
        self._mode = config.validation.mode
        self._domain: Domain = get_domain(config.env.name)
        scale = config.env.scales[0]
        self._instances = self._domain.instances(scale, config.validation.instances, config.validation.seed)
        self._settings = Settings(
            episodes=config.validation.episodes,
            seed=config.validation.seed,
            view=config.make_view(),
            objective=config.env.objective,
            horizon=config.validation.length,
            scale=scale,
            options=config.env.options,
        )

    def __call__(self, network: PolicyNetwork) -> float:
        """M1, the mean over instances and episodes."""
        policy = NetworkPolicy(network, mode=self._mode)
        scores = evaluate_scheduler(self._domain, policy, self._instances, self._settings)
        return float(scores.measures[str(self._settings.objective)].mean())

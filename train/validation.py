"""Which of a run's policies is best: play on fixed instances with the same noise every time."""

from __future__ import annotations

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import Domain, get_domain
from marl_sched.problem import Problem
from marl_sched.train.config import TrainConfig
from marl_sched.train.evaluation.evaluate import evaluate_scheduler


class Validation:
    """The mean of the run's objective that a network reaches on the validation instances."""

    def __init__(self, config: TrainConfig) -> None:
        self._mode = config.validation.mode
        self._domain: Domain = get_domain(config.env.name)
        scales = config.env.scales
        self._problem = Problem(
            self._domain,
            instances=self._domain.instances(
                scales[0], config.validation.instances, config.validation.seed, "validation"
            ),
            pad=max(scales, key=list(self._domain.scales).index),  # whose padding some networks are bound to
            episodes=config.validation.episodes,
            seed=config.validation.seed,
            view=config.make_view(),
            objective=config.env.objective,
            horizon=config.validation.length,
            options=config.env.options,
        )

    def prefers(self, score: float, other: float) -> bool:
        """Whether a score is the better one."""
        return score < other if self._domain.better == "lower" else score > other

    def __call__(self, network: PolicyNetwork) -> float:
        """M1, the mean over instances and episodes."""
        policy = NetworkPolicy(network, mode=self._mode, domain=self._domain.name)
        scores = evaluate_scheduler(self._problem, policy)
        return float(scores.measures[self._problem.objective].mean())

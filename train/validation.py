"""Which of a run's policies is best: play on fixed instances with the same noise every time."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.policies.network_policy import policy_of
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import Domain, get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.problem import Problem
from marl_sched.train.config import TrainConfig
from marl_sched.train.evaluation.evaluate import evaluate_scheduler


class Validation:
    """How well a network does on validation instances of every scale that the run is trained on.

    Raises UnknownNameError for a baseline that nobody has.
    """

    def __init__(self, config: TrainConfig) -> None:
        validation, scales = config.validation, config.env.scales
        self._mode = validation.mode
        self._domain: Domain = get_domain(config.env.name)
        self._baseline = None if validation.baseline is None else create_scheduler(validation.baseline, self._domain)
        self._problems = {
            scale: Problem(
                self._domain,
                scale=scale,
                count=validation.instances,
                split="validation",
                pad=self._domain.largest_scale(scales),  # whose padding some networks are bound to
                episodes=validation.episodes,
                seed=validation.seed,
                view=config.make_view(),
                objective=config.env.objective,
                horizon=validation.length,
                options=config.env.options,
            )
            for scale in scales
        }

    def prefers(self, score: float, other: float) -> bool:
        """Whether a score is the better one."""
        return score < other if self._domain.better == "lower" else score > other

    def __call__(self, network: PolicyNetwork) -> dict[str, float]:
        """M1 on every scale, the mean over its instances and episodes."""
        return self._means(policy_of(network, mode=self._mode, domain=self._domain.name))

    def score(self, means: Mapping[str, float]) -> float:
        """What policies are compared by: the mean over scales of M1, of its ratio to the baseline's if there is one.

        Raises InvalidOptionError for a baseline whose M1 is not positive.
        """
        if self._baseline is None:
            return float(np.mean(list(means.values())))
        return float(np.mean([mean / self._base[scale] for scale, mean in means.items()]))

    @cached_property
    def _base(self) -> dict[str, float]:
        """The baseline's M1."""
        assert self._baseline is not None
        base = self._means(self._baseline)
        for scale, mean in base.items():
            if not mean > 0:
                raise InvalidOptionError(
                    f"validation.baseline: expected a scheduler of positive {self._problems[scale].objective}, got "
                    f"{mean:g} by {self._baseline.name} on {scale}"
                )
        return base

    def _means(self, scheduler: Scheduler) -> dict[str, float]:
        return {
            scale: float(evaluate_scheduler(problem, scheduler).measures[problem.objective].mean())
            for scale, problem in self._problems.items()
        }

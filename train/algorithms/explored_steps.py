"""Learning what the steps of one's own schedules cost, for networks that plan step by step (DAgger; Ross et al. 2011).

The network plans training instances itself, by sampling, and so meets its own mistakes. At every step a rule of the
domain completes the schedule after each action that is offered, and says what that comes to
(`StepwiseNetwork.explored`). An excess cost is an action's share above the least one; the network learns the
distribution softmax(-excess / temperature) by cross-entropy, so that actions of the same cost are all right. An update
learns from instances of one scale; scales take turns.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.planner import StepwiseNetwork
from marl_sched.train.algorithms.base import NAME, Setup
from marl_sched.train.algorithms.demonstrations import Steps, require_sync, stepwise
from marl_sched.train.algorithms.imitation import cross_entropy
from marl_sched.train.algorithms.rollout_imitation import WORST, excess_costs
from marl_sched.train.algorithms.supervised import SupervisedConfig, SupervisedLearner
from marl_sched.train.bounds import Count, Positive
from marl_sched.train.collect import Collector
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

COSTS = "costs"


class ExploredStepsConfig(SupervisedConfig, frozen=True, kw_only=True, tag_field=NAME, tag="explored_steps"):
    """New `instances` for each update; temperature and learning rate change linearly."""

    instances: Count
    temperature: Positive
    final_temperature: Positive

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig; InvalidOptionError for a network that does not plan step by step."""
        require_sync(setup)
        collector = ExploringCollector(self, setup)
        return collector, StepCosts(stepwise(setup, collector.player()), self)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """What the rule knows that completes schedules."""
        return ["completion of its own schedules by a rule that knows all constraints"]


class ExploringCollector:
    """Lets the network plan the update's instances, which no other update has.

    Args:
        config: of the algorithm.
        setup: of the run; instances are those of its scales in the split "train".
    """

    name = "sync"

    def __init__(self, config: ExploredStepsConfig, setup: Setup) -> None:
        self._count, self._seed = config.instances, setup.config.seed
        self._problems = [setup.problem(scale, horizon=1) for scale in setup.config.env.scales]
        self._updates = 0

    def player(self) -> object:
        """A simulator of the first instance."""
        return self._problems[0].simulator_of([self._problems[0].instance(0)], pad=None)

    def collect(self, policy: PolicyNetwork, length: int) -> Steps:
        """The steps that the network comes to, and what its actions there cost."""
        assert isinstance(policy, StepwiseNetwork)  # build() made it
        begun, update = time.perf_counter(), self._updates
        problem = self._problems[update % len(self._problems)]
        numbers = range(update * self._count, (update + 1) * self._count)
        rng = np.random.default_rng([self._seed, update])
        arrays = policy.explored([problem.instance(number) for number in numbers], rng)
        self._updates += 1
        steps = TensorDict({name: torch.from_numpy(array) for name, array in arrays.items()}, len(arrays[COSTS]))
        bring = -float(arrays[COSTS].min(axis=1).mean())
        return Steps(steps=steps, reward_rate=bring, length=1, time=self._count, seconds=time.perf_counter() - begun)

    def state(self) -> dict[str, np.ndarray]:
        """The number of updates."""
        return {"updates": np.array([self._updates])}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a saved state."""
        self._updates = int(state["updates"][0])

    def close(self) -> None:
        """Nothing runs beside it."""


class StepCosts(SupervisedLearner):
    """Learns which actions cost least.

    Args:
        policy: observation -> worths of actions (K, n_actions).
        config: see ExploredStepsConfig.
    """

    figures = ("regret", "entropy")

    def __init__(self, policy: StepwiseNetwork, config: ExploredStepsConfig) -> None:
        super().__init__(policy, config)
        self._config = config

    def learn(self, rollout: Steps, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Go over the steps."""
        samples = rollout.steps.exclude(COSTS)
        samples["excess"] = excess_costs(rollout.steps[COSTS])
        samples["weight"] = torch.ones(len(samples))
        return self.fit(samples, progress, rng)

    def _losses(self, batch: TensorDict, log_probs: Tensor, progress: float) -> Tensor:
        temperature = between(self._config.temperature, self._config.final_temperature, progress)
        return cross_entropy(log_probs, (-batch["excess"] / temperature).softmax(-1))

    def _figures(self, batch: TensorDict, log_probs: Tensor) -> list[Tensor]:
        probs = log_probs.exp()
        return [(probs * batch["excess"].clamp(max=WORST)).sum(-1), cross_entropy(log_probs, probs)]

"""Imitation of whole schedules that an expert makes, such as a solver (dissertation, sections 3.4.2 and 4.3.3).

The expert plays training instances, and its schedules are taken apart into the steps of a planner's network
(`StepwiseNetwork`): in which state it chose what. Instances are solved when they are first needed; the schedules are
part of the checkpoint, so that none is solved twice. An update learns from instances of one scale; scales take turns.

By the criterion `ranking` the network learns the expert's choice by cross-entropy among the actions that were open. By
`values` it learns what follows, R, as published (equations 3.12 to 3.14): the loss of a step is

    (Q(expert's) - R)^2 + alternatives x mean over the other actions of (Q - min(Q, R - offset))^2

and `weight_decay` stands for the last term of equation 3.14.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.planner import StepwiseNetwork
from marl_sched.agents.playing import play
from marl_sched.agents.registry import create_scheduler
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.train.algorithms.base import NAME, Setup
from marl_sched.train.algorithms.supervised import SupervisedConfig
from marl_sched.train.bounds import Count, NonNegative, Share
from marl_sched.train.collect import Collector
from marl_sched.train.device import device_of
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between, means

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

_UNSOLVED = -1
LABEL, RETURN = "label", "return"


class DemonstrationsConfig(SupervisedConfig, frozen=True, kw_only=True, tag_field=NAME, tag="demonstrations"):
    """What an expert's schedules teach; `instances` of `problems` for each update, in turn.

    `expert_options` are the expert's own, `discount` is of what steps bring, see the module's page for the criteria.
    """

    instances: Count
    problems: Count
    expert: str
    expert_options: dict[str, Any] | None
    criterion: Literal["ranking", "values"]
    discount: Share
    offset: NonNegative
    alternatives: NonNegative
    weight_decay: NonNegative

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig; InvalidOptionError for a network that does not plan step by step."""
        require_sync(setup)
        collector = ExpertCollector(self, setup)
        return collector, ValueImitation(stepwise(setup, collector.player(0)), self)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The expert's."""
        expert = create_scheduler(self.expert, config.env.name, **(self.expert_options or {}))
        known = f" ({expert.privileged_info})" if expert.privileged_info else ""
        return [f"imitation of {expert.name}{known}"]


def require_sync(setup: Setup) -> None:
    """Raise InvalidOptionError for a collector that works elsewhere: planners' schedules are made in this process."""
    config = setup.config
    if config.collector.name != "sync":
        name = config.algorithm.algorithm_name()
        raise InvalidOptionError(f"train: collector: {name} plans here: expected sync, got {config.collector.name}")


def stepwise(setup: Setup, simulator: Any) -> StepwiseNetwork:
    """The run's freshly drawn network; InvalidOptionError for one that does not plan step by step."""
    network = setup.policy_for(simulator)
    if not isinstance(network, StepwiseNetwork):
        name, got = setup.config.algorithm.algorithm_name(), setup.config.policy.network_name()
        raise InvalidOptionError(f"train: policy: {name} is for networks that plan step by step, got {got}")
    return network


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Steps of schedules, as experience of an update.

    Attributes:
        steps: batch (K,), what the network reads, and what is learned of it.
        reward_rate: what an instance brings.
        length: of an episode, in the domain's unit.
        time: episodes that were taken apart.
        seconds: wall time.
    """

    steps: TensorDict
    reward_rate: float
    length: int
    time: int
    seconds: float

    @property
    def decisions(self) -> int:
        """K."""
        return int(self.steps.shape[0])


class ExpertCollector:
    """Solves training instances once, and takes their schedules apart in every update that learns from them.

    Args:
        config: of the algorithm.
        setup: of the run; instances are those of its scales in the split "train", one round or episode of length 1.
    """

    name = "sync"

    def __init__(self, config: DemonstrationsConfig, setup: Setup) -> None:
        self._config, self._scales = config, setup.config.env.scales
        self._problems = [setup.problem(scale, horizon=1) for scale in self._scales]
        self._expert = create_scheduler(config.expert, setup.config.env.name, **(config.expert_options or {}))
        self._schedules: dict[int, np.ndarray] = {}
        self._updates = 0

    def instance(self, number: int) -> Any:
        """Training instance `number`; every block of an update's instances is of one scale."""
        block = number // self._config.instances
        return self._problems[block % len(self._scales)].instance(number)

    def player(self, number: int) -> Any:
        """A simulator at the start of an instance."""
        block = number // self._config.instances
        return self._problems[block % len(self._scales)].simulator_of([self.instance(number)], pad=None)

    def collect(self, policy: PolicyNetwork, length: int) -> Steps:
        """The steps of this update's instances."""
        assert isinstance(policy, StepwiseNetwork)  # build() made it
        begun, config = time.perf_counter(), self._config
        first = self._updates * config.instances
        taken = []
        for number in range(first, first + config.instances):
            known = number % config.problems
            if known not in self._schedules:
                simulator = self.player(known)
                self._schedules[known] = policy.demonstration(play(self._expert, simulator), 0)
            if self._schedules[known].size:
                taken.append(policy.steps(self.instance(known), self._schedules[known], config.discount))
        self._updates += 1
        if not taken:
            raise InvalidOptionError(
                f"train: algorithm.expert: {config.expert} solved none of {config.instances} instances"
            )
        arrays = policy.gathered(taken)
        steps = TensorDict(
            {name: torch.from_numpy(array) for name, array in arrays.items()}, batch_size=len(arrays[LABEL])
        )
        bring = float(arrays[RETURN].mean())
        return Steps(steps=steps, reward_rate=bring, length=1, time=len(taken), seconds=time.perf_counter() - begun)

    def state(self) -> dict[str, np.ndarray]:
        """The number of updates and every schedule that was made, one behind the other."""
        lengths = np.full(self._config.problems, _UNSOLVED, np.int64)
        for number, schedule in self._schedules.items():
            lengths[number] = schedule.shape[1]
        solved = [self._schedules[number] for number in np.flatnonzero(lengths >= 0).tolist()]
        joined = np.concatenate(solved, axis=1) if solved else np.zeros((3, 0), np.int64)
        return {"updates": np.array([self._updates]), "lengths": lengths, "schedules": joined}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a saved state."""
        self._updates, at = int(state["updates"][0]), 0
        for number in np.flatnonzero(state["lengths"] >= 0).tolist():
            ends = at + int(state["lengths"][number])
            self._schedules[number] = state["schedules"][:, at:ends].copy()
            at = ends

    def close(self) -> None:
        """Nothing runs beside it."""


class ValueImitation:
    """Learns an expert's choices, or what follows from them.

    Args:
        policy: observation -> worths of actions (K, n_actions).
        config: see DemonstrationsConfig.
    """

    def __init__(self, policy: StepwiseNetwork, config: DemonstrationsConfig) -> None:
        self.policy: PolicyNetwork = policy
        self._config = config
        self.modules: dict[str, nn.Module] = {"policy": policy}
        self.optimizer = torch.optim.Adam(policy.parameters(), weight_decay=config.weight_decay, fused=True)

    def learn(self, rollout: Steps, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Go over the steps; the loss, how often the expert's choice is the best, and the gradient's norm."""
        config, device = self._config, device_of(self.policy)
        for group in self.optimizer.param_groups:
            group["lr"] = between(config.learning_rate, config.final_learning_rate, progress)
        steps, reports = rollout.steps.to(device), []
        parts = max(1, round(len(steps) / config.minibatch))
        for _ in range(config.epochs):
            for indices in torch.from_numpy(rng.permutation(len(steps))).tensor_split(parts):
                reports.append(self._step(steps[indices.to(device)]))
        return dict(zip(("policy_loss", "agreement", "gradient"), means(reports), strict=True))

    def _step(self, batch: TensorDict) -> Tensor:
        worths = self.policy(dict(batch.exclude(LABEL, RETURN).items()))
        label = batch[LABEL]
        losses = self._ranking(worths, label) if self._config.criterion == "ranking" else self._values(worths, batch)
        loss = losses.mean()
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self._config.max_grad_norm)
        self.optimizer.step()
        agreement = (worths.argmax(1) == label).float().mean()
        return torch.stack([loss.detach(), agreement, norm])

    @staticmethod
    def _ranking(worths: Tensor, label: Tensor) -> Tensor:
        return functional.cross_entropy(worths, label, reduction="none")

    def _values(self, worths: Tensor, batch: TensorDict) -> Tensor:
        label, brings = batch[LABEL][:, None], batch[RETURN].to(worths.dtype)
        expert = worths.gather(1, label).squeeze(1)
        others = (batch[ACTION_MASK] != 0).scatter(1, label, value=False)
        above = functional.relu(worths - (brings - self._config.offset)[:, None]).masked_fill(~others, 0.0)
        charged = above.square().sum(1) / others.sum(1).clamp(min=1)
        return (expert - brings).square() + self._config.alternatives * charged

    def state(self) -> dict[str, float | None]:
        """Nothing, beside modules and optimizer."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""

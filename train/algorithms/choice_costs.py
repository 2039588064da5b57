"""Learning what choices cost on average, for networks that draw whole sequences (AggreVaTeD; Sun et al. 2017).

The policy draws sequences of training instances, so that it meets its own mistakes. Along them a rule works out what
every choice that could be next costs if it completes the rest; an excess cost is its share above the least one. By the
criterion `improvement` the policy learns, by cross-entropy, what is proportional to pi exp(-excess / temperature), pi
being the policy with which the run began (a step of maximum a posteriori policy optimisation; Abdolmaleki et al. 2018,
arXiv 1806.06920). That finds good choices that were unlikely, and leaves the order of choices alone that cost the same.
By `expected_cost` it minimises sum over choices of pi excess, less temperature x entropy.

Every situation thus teaches about all choices, where PPO (`greedy_rollout`) learns about those that were drawn.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from msgspec import Struct
from torch import Tensor, nn

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.sequences import SequenceNetwork
from marl_sched.train.algorithms.base import NAME, AlgorithmConfig, Setup
from marl_sched.train.algorithms.rollout_imitation import WORST
from marl_sched.train.bounds import Count, NonNegative, Positive
from marl_sched.train.collect import Collector
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between, means
from marl_sched.train.sequence_play import instances_of_update, sequence_network

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

_DRAWS = 6  # last word of the seeds of sampled choices


class ChoiceCostsConfig(
    AlgorithmConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="choice_costs"
):
    """See the module's page; temperature and learning rate change linearly over the run."""

    instances: Count
    rounds: Count
    criterion: Literal["improvement", "expected_cost"]
    temperature: Positive
    final_temperature: Positive
    epochs: Count
    minibatches: Count
    learning_rate: Positive
    final_learning_rate: NonNegative
    max_grad_norm: Positive

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig; InvalidOptionError for a network that draws no sequences, and on a GPU."""
        return CostCollector(self, setup), ChoiceCosts(sequence_network(setup), self)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The rule's."""
        return ["costs of choices by completions of a rule"]


@dataclass(frozen=True, kw_only=True)
class PricedRound:
    """One sequence for each of P situations, and what else could have been chosen on the way.

    Attributes:
        situations, seen: as the network has them.
        orders: int64 (P, 1, N, k).
        excess: float32 (P, 1, L, M), of all choices, inf for impossible ones.
        there: bool (P, 1, L), there was one.
        costs: float64 (P,), what the sequences cost when they were played.
    """

    situations: Any
    seen: Any
    orders: np.ndarray
    excess: Tensor
    there: Tensor
    costs: np.ndarray


@dataclass(frozen=True, kw_only=True)
class PricedSequences:
    """What was played for an update: its rounds; `length` of an episode in the domain's unit, wall `seconds`."""

    played: list[PricedRound]
    length: int
    seconds: float

    @property
    def reward_rate(self) -> float:
        """Minus the mean cost of a sequence."""
        return -float(np.mean([one.costs.mean() for one in self.played]))

    @property
    def time(self) -> int:
        """Rounds that were played."""
        return sum(one.costs.size for one in self.played)

    @property
    def decisions(self) -> int:
        """Choices in them."""
        return int(sum(one.there.sum().item() for one in self.played))


class CostCollector:
    """Plays an update's instances, one sequence each, and works out what choices cost on the way."""

    name = "sync"

    def __init__(self, config: ChoiceCostsConfig, setup: Setup) -> None:
        self._config, self._setup, self._updates = config, setup, 0

    def collect(self, policy: PolicyNetwork, length: int) -> PricedSequences:
        """Play the update's instances."""
        assert isinstance(policy, SequenceNetwork)  # build() made it
        begun, config = time.perf_counter(), self._config
        simulator = instances_of_update(self._setup, self._updates, config.instances, 1, config.rounds)
        rng = np.random.default_rng([self._setup.config.seed, self._updates, _DRAWS])
        rows, played = np.arange(simulator.batch), []
        with torch.no_grad():
            for _ in range(config.rounds):
                situations = policy.situations(simulator, rows)
                longest, numbers = policy.choices(situations)
                drawn = policy.draw(situations, uniforms=rng.random((len(rows), 1, longest, numbers)))
                costs = policy.choice_costs(situations, drawn.orders)
                excess, there = excess_of(costs)
                executed = policy.execute(simulator, drawn.orders[:, 0])
                played.append(
                    PricedRound(
                        situations=situations, seen=drawn.seen, orders=drawn.orders, excess=excess, there=there,
                        costs=executed,
                    )
                )  # fmt: skip
        self._updates += 1
        return PricedSequences(played=played, length=config.rounds, seconds=time.perf_counter() - begun)

    def state(self) -> dict[str, np.ndarray]:
        """The number of updates."""
        return {"updates": np.array([self._updates])}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a saved state."""
        self._updates = int(state["updates"][0])

    def close(self) -> None:
        """Nothing runs beside it."""


def excess_of(costs: np.ndarray) -> tuple[Tensor, Tensor]:
    """Excess costs, float32 (..., M) as PricedRound has them, of float64 (..., M), and where there is a choice."""
    least = costs.min(axis=-1, keepdims=True)
    possible = np.isfinite(costs)
    with np.errstate(invalid="ignore"):
        excess = np.where(possible, (costs - least) / np.maximum(least, 1e-9), np.inf)
    return torch.from_numpy(excess).float(), torch.from_numpy(possible.sum(axis=-1) > 1)


class ChoiceCosts:
    """Learns from sequences whose choices have costs. Args: policy that draws; config, see ChoiceCostsConfig."""

    def __init__(self, policy: SequenceNetwork, config: ChoiceCostsConfig) -> None:
        self.policy: PolicyNetwork = policy
        self._network, self._config, self._updates = policy, config, 0
        self._first = copy.deepcopy(policy).requires_grad_(False)
        self.modules: dict[str, nn.Module] = {"policy": policy, "first": self._first}
        self.optimizer = torch.optim.Adam(policy.parameters(), fused=True)

    def learn(self, rollout: PricedSequences, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Several passes over an update's rounds."""
        config, reports = self._config, []
        if self._updates == 0:
            self._first.load_state_dict(self.policy.state_dict())  # which may be those of another run
        self._updates += 1
        for group in self.optimizer.param_groups:
            group["lr"] = between(config.learning_rate, config.final_learning_rate, progress)
        temperature = between(config.temperature, config.final_temperature, progress)
        targets = [self._improved(one, temperature) for one in rollout.played]
        for _ in range(config.epochs):
            for one, target in zip(rollout.played, targets, strict=True):
                for chosen in np.array_split(rng.permutation(len(one.orders)), config.minibatches):
                    reports.append(self._step(one, target, np.sort(chosen), temperature))
        return dict(zip(("policy_loss", "regret", "entropy", "gradient"), means(reports), strict=True))

    def _improved(self, one: PricedRound, temperature: float) -> Tensor | None:
        """What is proportional to pi exp(-excess / temperature), (P, 1, L, M); None where nobody asks."""
        if self._config.criterion != "improvement":
            return None
        with torch.no_grad():
            log_probs = self._first.choice_log_probs(one.situations, one.orders, one.seen)
            return (log_probs - one.excess / temperature).softmax(-1)

    def _step(self, one: PricedRound, improved: Tensor | None, chosen: np.ndarray, temperature: float) -> Tensor:
        """One step on some situations, int64 (K,); what is told of it."""
        config, network = self._config, self._network
        seen = None if one.seen is None else network.selected_seen(one.seen, chosen, 1)
        situations = network.selected(one.situations, chosen)
        log_probs = network.choice_log_probs(situations, one.orders[chosen], seen)
        length = log_probs.shape[2]
        there = one.there[chosen][:, :, :length]
        log_probs, excess = log_probs[there], one.excess[chosen][:, :, :length][there]
        probs = log_probs.exp()
        regret = (probs * excess.clamp(max=WORST)).sum(-1).mean()
        entropy = -(probs * log_probs).sum(-1).mean()
        if improved is None:
            loss = regret - temperature * entropy
        else:
            loss = -(improved[chosen][:, :, :length][there] * log_probs).sum(-1).mean()
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), config.max_grad_norm)
        self.optimizer.step()
        return torch.stack([loss.detach(), regret.detach(), entropy.detach(), norm])

    def state(self) -> dict[str, float | None]:
        """How many updates it has learned from."""
        return {"updates": float(self._updates)}

    def restore(self, state: dict[str, float | None]) -> None:
        """Go on from a saved state."""
        self._updates = int(state["updates"] or 0)

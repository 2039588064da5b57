"""PPO on whole sequences of choices with a greedy rollout baseline (dissertation, section 5.6, algorithm 4).

An update plays `rounds` rounds of `instances` training instances of one scale, `samples` times each and once more by
the baseline: a copy of the policy that chooses greedily and is renewed every `renew` updates. All copies of an instance
meet the same noise (line 6). A sequence's advantage is by how much it costs less, from its round on and discounted,
than what the baseline plays (line 24), as a share of that; the clipped surrogate's ratio is that of whole sequences
(equation 5.7). With `baseline: mean` it is the mean of the samples.

With `credit: step` every choice has an advantage and a ratio of its own. A choice's reward is by how much it lowers
what the sequence costs if a rule completes it (a potential; Ng, Harada and Russell 1999). The last one's also holds by
how much the executed round was cheaper than expected, less the same of the baseline's. Advantages are sums of later
rewards, each weighing `gae_lambda` times the one before: at 1 that is the sequence's cost against the rule's, at 0 a
choice counts as if the rule went on from there.

`imitation` weighs the cross-entropy to a sequence of an instance's first round: a teacher's good one while
`teacher_share` of the run lasts, or else the cheapest sample (self-labelling, Corsini et al. 2024, arXiv 2401.11849).
With `surrogate: 0` that is all that is learned.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from msgspec import Meta, Struct
from torch import Tensor, nn

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.sequences import SequenceNetwork
from marl_sched.agents.planning import TeamPlanner
from marl_sched.agents.registry import create_scheduler
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator
from marl_sched.train.algorithms.base import NAME, AlgorithmConfig, Setup
from marl_sched.train.bounds import Count, NonNegative, Positive, Share
from marl_sched.train.collect import Collector
from marl_sched.train.learner import Learner
from marl_sched.train.ppo import between, means
from marl_sched.train.sequence_play import instances_of_update, sequence_network

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

_DRAWS = 5  # last word of the seeds of sampled choices
MOST = 5.0  # of an advantage, in standard deviations


class GreedyRolloutConfig(
    AlgorithmConfig,
    Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field=NAME,
    tag="greedy_rollout",
):
    """See the module's page. Learning rate, entropy bonus and imitation change linearly over the run."""

    instances: Count
    samples: Annotated[int, Meta(ge=2)]
    rounds: Count
    baseline: Literal["greedy", "mean"]
    credit: Literal["sequence", "step"]
    gae_lambda: Share
    renew: Count
    discount: Share
    surrogate: NonNegative
    clip: Positive
    imitation: NonNegative
    final_imitation: NonNegative
    teacher: str | None
    teacher_options: dict[str, Any]
    teacher_share: Share
    entropy: NonNegative
    final_entropy: NonNegative
    epochs: Count
    minibatches: Count
    learning_rate: Positive
    final_learning_rate: NonNegative
    weight_decay: NonNegative
    max_grad_norm: Positive

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """See AlgorithmConfig; InvalidOptionError for a network that draws no sequences, and on a GPU."""
        network = sequence_network(setup)
        baseline = copy.deepcopy(network).requires_grad_(False)
        return SequenceCollector(self, setup, baseline), GreedyRollout(network, baseline, self)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """The teacher's."""
        if self.teacher is None or not self.teacher_share:
            return []
        teacher = create_scheduler(self.teacher, config.env.name, **self.teacher_options)
        known = f" ({teacher.privileged_info})" if teacher.privileged_info else ""
        return [f"imitation of {teacher.name}{known}"]


@dataclass(frozen=True, kw_only=True)
class PlayedRound:
    """One round of all samples: P situations with S sequences each; from the second round on S is 1.

    Attributes:
        situations: as the network has them.
        orders: int64 (P, S, N, k).
        log_probs: (P, S, L), under the policy that drew.
        seen: what it read on the way.
        lengths: int64 (P,), of sequences.
        costs: float64 (instances x samples), of this round.
        baseline: float64 (instances,), what the baseline's sequences cost.
        appraisals: float64 (P, S, L + 1), see Drawn; None: sequences have credit as wholes.
        expected: float64 (instances,), what the baseline's sequences were appraised at; None likewise.
    """

    situations: Any
    orders: np.ndarray
    log_probs: Tensor
    seen: Any
    lengths: np.ndarray
    costs: np.ndarray
    baseline: np.ndarray
    appraisals: np.ndarray | None
    expected: np.ndarray | None


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """What was played for an update.

    Attributes:
        played: the rounds.
        best: int64 (instances, 1, N, k), sequences of the first round, to be imitated where `better`.
        better: bool (instances,).
        length: of an episode, in the domain's unit; seconds: wall time.
    """

    played: list[PlayedRound]
    best: np.ndarray
    better: np.ndarray
    length: int
    seconds: float

    @property
    def reward_rate(self) -> float:
        """Minus the mean cost of a sampled sequence."""
        return -float(np.mean([one.costs.mean() for one in self.played]))

    @property
    def time(self) -> int:
        """Rounds that were played, over all samples."""
        return sum(one.costs.size for one in self.played)

    @property
    def decisions(self) -> int:
        """Choices in them."""
        return int(sum(one.lengths.sum() * one.orders.shape[1] for one in self.played))


class SequenceCollector:
    """Plays an update's instances; every update's are new and of the next scale.

    Args:
        config: of the algorithm.
        setup: of the run.
        baseline: the network that plays greedily; renewed by the learner.
    """

    name = "sync"

    def __init__(self, config: GreedyRolloutConfig, setup: Setup, baseline: SequenceNetwork) -> None:
        self._config, self._baseline, self._setup, self._run = config, baseline, setup, setup.config
        self._teacher: TeamPlanner[Any] | None = None
        if config.teacher is not None and config.teacher_share:
            teacher = create_scheduler(config.teacher, setup.config.env.name, **config.teacher_options)
            if not isinstance(teacher, TeamPlanner):
                raise InvalidOptionError(f"train: algorithm.teacher: expected a planner, got {config.teacher}")
            self._teacher = teacher
        self._updates = 0

    def simulator(self) -> TurnSimulator:
        """Every instance of this update `samples` + 1 times in a row, the last one for the baseline."""
        config = self._config
        return instances_of_update(self._setup, self._updates, config.instances, config.samples + 1, config.rounds)

    def collect(self, policy: PolicyNetwork, length: int) -> Sequences:
        """Play the update's instances."""
        assert isinstance(policy, SequenceNetwork)  # build() made it
        begun, config, simulator = time.perf_counter(), self._config, self.simulator()
        rng = np.random.default_rng([self._run.seed, self._updates, _DRAWS])
        rows = np.arange(simulator.batch).reshape(config.instances, config.samples + 1)
        taught = None
        if self._teacher is not None and self._updates < config.teacher_share * self._run.updates:
            taught = policy.planned(self._teacher, simulator, rows[:, 0])
        played = []
        with torch.no_grad():
            for number in range(config.rounds):
                played.append(self._round(policy, simulator, rows, number, rng))
        best, better = self._best(policy, played[0], taught)
        self._updates += 1
        return Sequences(
            played=played, best=best, better=better, length=config.rounds, seconds=time.perf_counter() - begun
        )

    def _round(
        self, policy: SequenceNetwork, simulator: TurnSimulator, rows: np.ndarray, number: int, rng: np.random.Generator
    ) -> PlayedRound:
        """Draw for all rows, in the first round for all copies of an instance at once, and play."""
        samples = self._config.samples
        sampled = rows[:, 0] if number == 0 else rows[:, :samples].ravel()
        situations = policy.situations(simulator, sampled)
        longest, numbers = policy.choices(situations)
        uniforms = rng.random((len(sampled), samples if number == 0 else 1, longest, numbers))
        appraise = self._config.credit == "step"
        drawn = policy.draw(situations, uniforms.shape[1], uniforms=uniforms, appraise=appraise)
        greedy = self._baseline.draw(policy.situations(simulator, rows[:, samples]), appraise=appraise)
        orders = np.concatenate([drawn.orders.reshape(len(rows), samples, longest, -1), greedy.orders], axis=1)
        costs = policy.execute(simulator, orders.reshape(simulator.batch, longest, -1)).reshape(rows.shape)
        return PlayedRound(
            situations=situations,
            orders=drawn.orders,
            log_probs=drawn.log_probs,
            seen=drawn.seen,
            lengths=drawn.lengths,
            costs=costs[:, :samples].copy(),
            baseline=costs[:, samples].copy(),
            appraisals=drawn.appraisals,
            expected=None if greedy.appraisals is None else greedy.appraisals[:, 0, -1],
        )

    def _best(
        self, policy: SequenceNetwork, first: PlayedRound, taught: tuple[np.ndarray, np.ndarray] | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What is imitated of the first round: good ones that are taught, and cheapest samples that beat their mean."""
        index = first.costs.argmin(axis=1)
        best = np.take_along_axis(first.orders, index[:, None, None, None], axis=1)
        better = first.costs.min(axis=1) < first.costs.mean(axis=1)
        if taught is None:
            return best, better
        orders, good = taught
        best[good] = orders[good]
        return best, better | good

    def state(self) -> dict[str, np.ndarray]:
        """The number of updates."""
        return {"updates": np.array([self._updates])}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a saved state."""
        self._updates = int(state["updates"][0])

    def close(self) -> None:
        """Nothing runs beside it."""


class GreedyRollout:
    """Learns from sequences; see the page.

    Args:
        policy: what draws.
        baseline: what is compared with, and renewed here.
        config: see GreedyRolloutConfig.
    """

    def __init__(self, policy: SequenceNetwork, baseline: SequenceNetwork, config: GreedyRolloutConfig) -> None:
        self.policy: PolicyNetwork = policy
        self._network, self._baseline, self._config = policy, baseline, config
        self._updates = 0
        self.modules: dict[str, nn.Module] = {"policy": policy, "baseline": baseline}
        self.optimizer = torch.optim.Adam(policy.parameters(), weight_decay=config.weight_decay, fused=True)

    def learn(self, rollout: Sequences, progress: float, rng: np.random.Generator) -> dict[str, float]:
        """Several passes over an update's instances, then, when it is time, renew the baseline."""
        config = self._config
        if self._updates == 0:
            self._renew()  # a run may have begun with the weights of another policy
        for group in self.optimizer.param_groups:
            group["lr"] = between(config.learning_rate, config.final_learning_rate, progress)
        estimate = sequence_advantages if config.credit == "sequence" else step_advantages
        advantages = estimate(rollout.played, config)
        reports = []
        for _ in range(config.epochs):
            for chosen in np.array_split(rng.permutation(config.instances), config.minibatches):
                reports.append(self._step(rollout, advantages, np.sort(chosen), progress))
        self._updates += 1
        if self._updates % config.renew == 0:
            self._renew()
        first = rollout.played[0]
        gain = float(np.mean(1.0 - first.costs.min(axis=1) / np.maximum(first.baseline, 1e-9)))
        names = ("policy_loss", "imitation_loss", "entropy", "kl", "clipped", "gradient")
        return {**dict(zip(names, means(reports), strict=True)), "gain": gain}

    def _step(self, rollout: Sequences, advantages: list[Tensor], chosen: np.ndarray, progress: float) -> Tensor:
        """One step on some instances, int64 (K,); what is told of it."""
        config, samples = self._config, self._config.samples
        terms = [torch.zeros(()) for _ in range(4)]
        loss = torch.zeros(())
        for number, one in enumerate(rollout.played) if config.surrogate else ():
            places = chosen if number == 0 else (chosen[:, None] * samples + np.arange(samples)).ravel()
            drawn = self._draw_again(one, places)
            there = torch.arange(drawn.log_probs.shape[2]) < torch.from_numpy(drawn.lengths)[:, None, None]
            ratio, old = drawn.log_probs, one.log_probs[places][:, :, : drawn.log_probs.shape[2]]
            advantage = advantages[number][places]
            if config.credit == "sequence":
                ratio, old, there = ratio.sum(2, keepdim=True), old.sum(2, keepdim=True), there[:, :, :1]
            ratio = (ratio - old)[there.expand_as(ratio)]
            advantage = advantage[:, :, : there.shape[2]][there.expand(-1, advantage.shape[1], -1)]
            surrogate = clipped_surrogate(ratio, advantage, config.clip)
            per_choice = (drawn.entropies / torch.from_numpy(drawn.lengths)[:, None]).mean()
            bonus = between(config.entropy, config.final_entropy, progress) * per_choice
            loss = loss - (config.surrogate * surrogate + bonus) / len(rollout.played)
            with torch.no_grad():
                change = ratio.exp() - 1.0
                told = (-surrogate, per_choice, (change - ratio).mean(), change.abs().gt(config.clip))
                terms = [a + b.float().mean() / len(rollout.played) for a, b in zip(terms, told, strict=True)]
        imitation, cross_entropy = between(config.imitation, config.final_imitation, progress), torch.zeros(())
        labelled = chosen[rollout.better[chosen]]
        if imitation and len(labelled):
            first = rollout.played[0]
            situations = self._network.selected(first.situations, labelled)
            taught = self._network.draw(situations, given=rollout.best[labelled])
            cross_entropy = -(taught.log_probs.sum(2) / torch.from_numpy(taught.lengths)[:, None]).mean()
            loss = loss + imitation * cross_entropy
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), config.max_grad_norm)
        self.optimizer.step()
        return torch.stack([terms[0], cross_entropy.detach(), *terms[1:], norm])

    def _draw_again(self, one: PlayedRound, places: np.ndarray) -> Any:
        """The sequences of some situations under the present weights."""
        situations = self._network.selected(one.situations, places)
        seen = None if one.seen is None else self._network.selected_seen(one.seen, places, one.orders.shape[1])
        return self._network.draw(situations, one.orders.shape[1], given=one.orders[places], seen=seen)

    def _renew(self) -> None:
        self._baseline.load_state_dict(self.policy.state_dict())

    def state(self) -> dict[str, float | None]:
        """How many updates it has learned from."""
        return {"updates": float(self._updates)}

    def restore(self, state: dict[str, float | None]) -> None:
        """Go on from a saved state."""
        self._updates = int(state["updates"] or 0)


def sequence_advantages(played: list[PlayedRound], config: GreedyRolloutConfig) -> list[Tensor]:
    """Advantages of every round's sequences, (P, S, 1), with standard deviation 1 over all rounds.

    What the baseline's rounds cost from here on, less what the sample's do, discounted, as a share of the former.
    """
    found, behind, base_behind = [], np.zeros(played[0].costs.shape), np.zeros(len(played[0].baseline))
    for one in reversed(played):
        behind = one.costs + config.discount * behind
        base_behind = one.baseline + config.discount * base_behind
        base = base_behind[:, None] if config.baseline == "greedy" else behind.mean(axis=1, keepdims=True)
        found.append((base - behind) / np.maximum(base_behind[:, None], 1e-9))
    spread = max(float(np.std(np.stack(found))), 1e-6)
    return [
        torch.from_numpy(np.clip(values / spread, -MOST, MOST)).float().view(*one.orders.shape[:2], 1)
        for values, one in zip(reversed(found), played, strict=True)
    ]


def step_advantages(played: list[PlayedRound], config: GreedyRolloutConfig) -> list[Tensor]:
    """Advantages of every choice, (P, S, L) for each round, with root mean square 1 over all; see the page."""
    found = []
    for one in played:
        assert one.appraisals is not None  # the collector asked for them
        assert one.expected is not None
        scale = np.maximum(one.appraisals[:, :, :1], 1e-9)
        rewards = -np.diff(one.appraisals, axis=2)
        executed = (one.costs - (one.baseline - one.expected)[:, None]).reshape(scale.shape[:2])
        last = np.broadcast_to(one.lengths[:, None], scale.shape[:2]) - 1
        rewards[(*np.indices(last.shape), last)] += one.appraisals[:, :, -1] - executed
        values, behind = np.zeros_like(rewards), np.zeros(scale.shape[:2])
        for k in reversed(range(rewards.shape[2])):
            behind = rewards[:, :, k] + config.gae_lambda * behind
            values[:, :, k] = behind
        found.append(values / scale)
    size = max(float(np.sqrt(np.mean(np.concatenate([values.ravel() for values in found]) ** 2))), 1e-6)
    return [torch.from_numpy(np.clip(values / size, -MOST, MOST)).float() for values in found]


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """Equation 5.7, the mean over sequences."""
    ratio = log_ratio.exp()
    return torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage).mean()

"""What a run is made of. Two algorithms differ by the parts they are given, not by a copied loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import torch

from marl_sched.agents.base import AdvantageScheduler, PrivilegedInfo
from marl_sched.agents.networks.architectures import new_network
from marl_sched.agents.networks.hetgat.network import HetGATCritic
from marl_sched.agents.networks.network import PolicyNetwork, slots_of
from marl_sched.agents.policies.cards import DecimaSizes, DeepRMSizes, HetGATSizes, Sizes, check_graph
from marl_sched.agents.policies.checkpoint import load_network
from marl_sched.agents.registry import create_scheduler, policy_path
from marl_sched.domain import get_domain
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidOptionError
from marl_sched.train.checkpoint import Counters, load_checkpoint, save_checkpoint
from marl_sched.train.collect import Collector, EpisodeCollector, InstanceSource, SegmentCollector
from marl_sched.train.config import (
    DecimaConfig,
    DeepRMConfig,
    GaeConfig,
    HetGATConfig,
    ImitationConfig,
    IppoConfig,
    PolicyConfig,
    RunRecord,
    Start,
    StateValueConfig,
    StepBaselineConfig,
    TrainConfig,
)
from marl_sched.train.curriculum import EpisodeLength
from marl_sched.train.device import pick_device
from marl_sched.train.estimators import CriticEstimator, OwnTurns, StepBaseline
from marl_sched.train.export import save_best
from marl_sched.train.imitation import Imitation
from marl_sched.train.learner import Learner, PolicyGradient
from marl_sched.train.ppo import Ppo
from marl_sched.train.state_value import StateValue, StateValueBaseline, TimedEpisodes
from marl_sched.train.validation import Validation


@dataclass(frozen=True)
class Parts:
    """The parts of a run, and what is done with all of them at once."""

    record: RunRecord
    collector: Collector
    learner: Learner
    length: EpisodeLength
    validation: Validation

    def start_from(self, name_or_path: str) -> Start:
        """Take over the weights of a trained policy, which must have the same sizes.

        Raises InvalidFileError for damaged files and another metagraph, UnknownNameError or InvalidOptionError.
        """
        path, network = policy_path(name_or_path), self.learner.policy
        first, card = load_network(path)
        check_graph(path, card, network.spec)
        if first.sizes != network.sizes:
            raise InvalidOptionError(f"train: start_from: expected a network of {network.sizes}, got {first.sizes}")
        network.load_state_dict(first.state_dict())
        return Start(weights_sha256=card.weights_sha256, command=card.command, knowledge=card.training_knowledge)

    def validate(self, counters: Counters, directory: Path) -> dict[str, float]:
        """Play the validation instances if it is time to, and keep the policy if it is the best so far."""
        config = self.record.config
        if counters.update % config.validation.every and counters.update != config.updates:
            return {}
        score = self.validation(self.learner.policy)
        if counters.best is None or self.validation.prefers(score, counters.best):
            counters.best = score
            save_best(self.learner.policy, self.record, counters.update, score, directory)
        return {"validation": score, "best": counters.best}

    def save(self, counters: Counters, directory: Path) -> None:
        """Write a checkpoint if it is time to."""
        config = self.record.config
        if counters.update % config.save_every and counters.update != config.updates:
            return
        save_checkpoint(directory, counters, self.learner, self.collector.state())

    def restore(self, directory: Path) -> Counters:
        """Put everything back as the last checkpoint has it."""
        counters, collector = load_checkpoint(directory, self.learner, list(self.collector.state()))
        self.collector.restore(collector)
        return counters


def build(record: RunRecord) -> Parts:
    """The parts that a run's configuration names, with freshly drawn networks."""
    config = record.config
    length = EpisodeLength(**msgspec.structs.asdict(config.curriculum), seed=config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(config.seed)
        collector, learner = _with_algorithm(config, length)
    return Parts(record, collector, learner, length, Validation(config))


def _with_algorithm(config: TrainConfig, length: EpisodeLength) -> tuple[Collector, Learner]:
    match config.algorithm:
        case GaeConfig() as algorithm:
            return _with_critic(config, algorithm, length, CriticEstimator, central=_hides(config))
        case IppoConfig() as algorithm:
            return _with_critic(config, algorithm, length, OwnTurns, central=False)
        case StepBaselineConfig() as algorithm:
            return _with_step_baseline(config, algorithm, length)
        case StateValueConfig() as algorithm:
            return _with_state_value(config, algorithm, length)
        case ImitationConfig() as algorithm:
            return _with_teacher(config, algorithm, length)


def _with_critic(
    config: TrainConfig,
    algorithm: GaeConfig | IppoConfig,
    length: EpisodeLength,
    estimator: type[CriticEstimator],
    *,
    central: bool,
) -> tuple[Collector, Learner]:
    env = _environment(config, length, rows=algorithm.instances, episodes=1)
    critic = _critic(config, env, algorithm.critic)
    credit = estimator(
        critic,
        discount=algorithm.discount,
        gae_lambda=algorithm.gae_lambda,
        reward_centering=algorithm.reward_centering,
    )
    learner = PolicyGradient(Ppo(_policy(config, env), critic, algorithm.ppo), credit)
    return SegmentCollector(env, turns=algorithm.turns, length=length(0), central=central), learner


def _with_step_baseline(
    config: TrainConfig, algorithm: StepBaselineConfig, length: EpisodeLength
) -> tuple[Collector, Learner]:
    rows = algorithm.instances * algorithm.episodes
    env = _environment(config, length, rows=rows, episodes=algorithm.episodes)
    estimator = StepBaseline(discount=algorithm.discount, episodes=algorithm.episodes)
    learner = PolicyGradient(Ppo(_policy(config, env), None, algorithm.ppo), estimator)
    return EpisodeCollector(env, central=False), learner


def _with_state_value(
    config: TrainConfig, algorithm: StateValueConfig, length: EpisodeLength
) -> tuple[Collector, Learner]:
    rows = algorithm.instances * algorithm.episodes
    env = _environment(config, length, rows=rows, episodes=algorithm.episodes)
    critic = StateValue(env.simulator.graph, **msgspec.structs.asdict(algorithm.critic)).to(pick_device(config.device))
    estimator = StateValueBaseline(critic, discount=algorithm.discount)
    learner = PolicyGradient(Ppo(_policy(config, env), critic, algorithm.ppo), estimator)
    return TimedEpisodes(env, central=False), learner


def _with_teacher(config: TrainConfig, algorithm: ImitationConfig, length: EpisodeLength) -> tuple[Collector, Learner]:
    env = _environment(config, length, rows=algorithm.instances, episodes=1)
    teacher = create_scheduler(algorithm.teacher, config.env.name)
    if not isinstance(teacher, AdvantageScheduler):
        raise InvalidOptionError(
            f"train: algorithm.teacher: expected a scheduler that can tell how good every choice is, "
            f"got {algorithm.teacher}"
        )
    if (
        PrivilegedInfo.TIME_LEFT in teacher.privileged_info
    ):  # training episodes are cut before the end that such a teacher plans for
        raise InvalidOptionError(
            f"train: algorithm.teacher: expected a scheduler that does not heed the time left, got {algorithm.teacher}"
        )
    teacher.start(env.simulator, np.ones(env.simulator.batch, np.bool_))
    collector = SegmentCollector(env, turns=algorithm.turns, length=length(0), central=_hides(config))
    return collector, Imitation(_policy(config, env), teacher, algorithm)


def _hides(config: TrainConfig) -> bool:
    """Whether agents see less than everything, so that the full graph is recorded beside their own."""
    return bool(config.make_view().hides)


def _critic(config: TrainConfig, env: SchedulingTorchRL, sizes: HetGATConfig) -> HetGATCritic:
    return HetGATCritic(env.simulator.graph, **msgspec.structs.asdict(sizes)).to(pick_device(config.device))


def _policy(config: TrainConfig, env: SchedulingTorchRL) -> PolicyNetwork:
    """A freshly drawn network. Weights are drawn on the CPU, so that a seed's are the same on every device."""
    return new_network(env.simulator.graph, _sizes(config.policy, env)).to(pick_device(config.device))


def _sizes(policy: PolicyConfig, env: SchedulingTorchRL) -> Sizes:
    """A network's sizes: those of the configuration and, for one that is bound to them, the environment's slots."""
    given = msgspec.structs.asdict(policy)
    match policy:
        case HetGATConfig():
            return HetGATSizes(**given)
        case DecimaConfig():
            return DecimaSizes(**given)
        case DeepRMConfig():
            return DeepRMSizes(**given, slots=slots_of(env.simulator.graph, env.simulator.arrays))


def _environment(config: TrainConfig, length: EpisodeLength, *, rows: int, episodes: int) -> SchedulingTorchRL:
    domain, scales = get_domain(config.env.name), config.env.scales
    return SchedulingTorchRL(
        domain,
        batch_size=rows,
        scale=max(scales, key=list(domain.scales).index),
        source=InstanceSource(domain, scales, seed=config.seed, rows=rows, episodes=episodes),
        view=config.make_view(),
        objective=config.env.objective,
        horizon=2 * length.longest,  # cuts come before the end, so that a state at a cut still has a value
        seed=config.seed,
        **config.env.options,
    )

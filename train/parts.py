"""What a run is made of. Two algorithms differ by the parts they are given, not by a copied loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import torch

from marl_sched.agents.hetgat.network import HetGATCritic, HetGATNetwork
from marl_sched.domain import get_domain
from marl_sched.envs.torchrl_env import SchedulingTorchRL
from marl_sched.graph import GraphSpec
from marl_sched.train.checkpoint import Counters, load_checkpoint, save_checkpoint
from marl_sched.train.collect import Collector, EpisodeCollector, InstanceSource, SegmentCollector
from marl_sched.train.config import GaeConfig, RunRecord, StepBaselineConfig, TrainConfig
from marl_sched.train.curriculum import EpisodeLength
from marl_sched.train.estimators import CriticEstimator, Estimator, StepBaseline
from marl_sched.train.export import save_best
from marl_sched.train.ppo import Ppo
from marl_sched.train.validation import Validation


@dataclass(frozen=True)
class Parts:
    """The parts of a run, and what is done with all of them at once."""

    record: RunRecord
    collector: Collector
    estimator: Estimator
    ppo: Ppo
    length: EpisodeLength
    validation: Validation

    @property
    def graph(self) -> GraphSpec:
        """The metagraph of what is learned on."""
        return self.collector.env.simulator.graph

    def validate(self, counters: Counters, directory: Path) -> dict[str, float]:
        """Play the validation instances if it is time to, and keep the policy if it is the best so far."""
        config = self.record.config
        if counters.update % config.validation.every and counters.update != config.updates:
            return {}
        score = self.validation(self.ppo.policy)
        if counters.best is None or score > counters.best:
            counters.best = score
            save_best(self.ppo.policy, self.record, counters.update, score, directory)
        return {"validation": score, "best": counters.best}

    def save(self, counters: Counters, directory: Path) -> None:
        """Write a checkpoint if it is time to."""
        config = self.record.config
        if counters.update % config.save_every and counters.update != config.updates:
            return
        save_checkpoint(directory, counters, self.ppo, self.estimator.state(), self.collector.state())

    def restore(self, directory: Path) -> Counters:
        """Put everything back as the last checkpoint has it."""
        numbers, collector = load_checkpoint(directory, self.ppo, list(self.collector.state()))
        self.estimator.restore(numbers.estimator)
        self.collector.restore(collector)
        return numbers.counters


def build(record: RunRecord) -> Parts:
    """The parts that a run's configuration names, with freshly drawn networks."""
    config, algorithm = record.config, record.config.algorithm
    length = EpisodeLength(**msgspec.structs.asdict(config.curriculum), seed=config.seed)
    with torch.random.fork_rng():
        torch.manual_seed(config.seed)
        if isinstance(algorithm, GaeConfig):
            collector, estimator, critic = _with_critic(config, algorithm, length)
        else:
            collector, estimator, critic = _with_step_baseline(config, algorithm, length)
        policy = HetGATNetwork(collector.env.simulator.graph, **msgspec.structs.asdict(config.policy))
    ppo = Ppo(policy, critic, algorithm.ppo)
    return Parts(record, collector, estimator, ppo, length, Validation(config))


_Chosen = tuple[Collector, Estimator, HetGATCritic | None]


def _with_critic(config: TrainConfig, algorithm: GaeConfig, length: EpisodeLength) -> _Chosen:
    env = _environment(config, length, rows=algorithm.instances, episodes=1)
    central = config.view["kind"] != "full"
    collector = SegmentCollector(env, turns=algorithm.turns, length=length(0), central=central)
    critic = HetGATCritic(env.simulator.graph, **msgspec.structs.asdict(algorithm.critic))
    estimator = CriticEstimator(critic, discount=algorithm.discount, trace=algorithm.trace, centred=algorithm.centred)
    return collector, estimator, critic


def _with_step_baseline(config: TrainConfig, algorithm: StepBaselineConfig, length: EpisodeLength) -> _Chosen:
    rows = algorithm.instances * algorithm.episodes
    env = _environment(config, length, rows=rows, episodes=algorithm.episodes)
    estimator = StepBaseline(discount=algorithm.discount, episodes=algorithm.episodes)
    return EpisodeCollector(env, central=False), estimator, None


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

"""What a run is made of. Two algorithms differ by the parts they are given, not by a copied loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import torch

from marl_sched.agents.policies.cards import check_graph
from marl_sched.agents.policies.checkpoint import load_network
from marl_sched.agents.registry import policy_path
from marl_sched.errors import InvalidOptionError
from marl_sched.train.algorithms.base import Setup
from marl_sched.train.checkpoint import Counters, load_checkpoint, save_checkpoint
from marl_sched.train.collect import Collector
from marl_sched.train.config import (
    RunRecord,
    Start,
)
from marl_sched.train.curriculum import EpisodeLength
from marl_sched.train.export import save_best
from marl_sched.train.learner import Learner
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
        means = self.validation(self.learner.policy)
        score = self.validation.score(means)
        if counters.best is None or self.validation.prefers(score, counters.best):
            counters.best = score
            save_best(self.learner.policy, self.record, counters.update, means, directory)
        by_scale = {f"validation_{scale}": mean for scale, mean in means.items()} if len(means) > 1 else {}
        return {"validation": score, **by_scale, "best": counters.best}

    def save(self, counters: Counters, directory: Path, *, now: bool = False) -> None:
        """Write a checkpoint if it is time to, or `now`."""
        config = self.record.config
        if not now and counters.update % config.save_every and counters.update != config.updates:
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
        collector, learner = config.algorithm.build(Setup(config, length))
    return Parts(record, collector, learner, length, Validation(config))

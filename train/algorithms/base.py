"""What every learning algorithm is made from, and the registry of algorithms by name.

An algorithm costs one module of this package: its parts and, beside them, a subclass of `AlgorithmConfig`, which is
what `configs/algorithm/NAME.yaml` may hold, the algorithm's registration, and its construction. A distribution that
brings an algorithm of its own names its module in the entry point group `marl_sched.algorithms`.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from marl_sched.agents.networks.hetgat.network import HetGATConfig, HetGATCritic
from marl_sched.agents.networks.network import PolicyNetwork, slots_of
from marl_sched.domain import get_domain
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidOptionError, UnknownNameError
from marl_sched.problem import Problem
from marl_sched.simulation import TurnSimulator
from marl_sched.train.collect import Collector, SegmentCollector, segment_collector
from marl_sched.train.curriculum import EpisodeLength
from marl_sched.train.device import pick_device
from marl_sched.train.environment import TrainingTask
from marl_sched.train.learner import Learner

if TYPE_CHECKING:
    from marl_sched.train.config import TrainConfig

GROUP = "marl_sched.algorithms"
NAME = "name"


@dataclass(frozen=True)
class Setup:
    """What a run's configuration says apart from the algorithm, and what is made of it.

    Attributes:
        config: of the run.
        length: of its episodes.
    """

    config: TrainConfig
    length: EpisodeLength

    @cached_property
    def hides(self) -> bool:
        """Whether agents see less than everything, so that the full graph is recorded beside their own."""
        return bool(self.config.make_view().hides)

    def whole_episodes(self, *, rows: int, episodes: int) -> TrainingTask:
        """`rows` episodes at once, each instance played `episodes` times, as wholes.

        Raises InvalidOptionError for a collector other than sync: the rows of an instance are played in lock-step to
        their ends, and TorchRL's workers play a number of turns that is fixed before.
        """
        if self.config.collector.name != "sync":
            raise InvalidOptionError(
                f"train: collector: {self.config.algorithm.algorithm_name()} plays whole episodes: expected sync, "
                f"got {self.config.collector.name}"
            )
        return self._task(rows=rows, episodes=episodes)

    def segments(self, *, rows: int, turns: int, central: bool, teacher: str = "") -> SegmentCollector:
        """A collector of `turns` turns of every row for each update; see TrainingTask."""
        task = self._task(rows=rows, turns=turns, central=central, teacher=teacher)
        return segment_collector(task, self.config.collector.name, self.config.collector.workers)

    def _task(self, **options: Any) -> TrainingTask:
        config = self.config
        domain = get_domain(config.env.name)
        problem = self.problem(
            domain.largest_scale(config.env.scales),
            horizon=2 * self.length.longest,  # cuts come before the end, so that a state at a cut still has a value
        )
        return TrainingTask(
            problem=problem,
            scales=config.env.scales,
            length=self.length,
            memory=config.policy.memory_size,
            **options,
        )

    def problem(self, scale: str, **words: Any) -> Problem:
        """What a run is about, with instances of a scale that training draws; `words` are those of Problem."""
        config = self.config
        given = {"seed": config.seed, "split": "train", **words}
        return Problem(
            get_domain(config.env.name),
            scale=scale,
            objective=config.env.objective,
            view=config.view,
            options=config.env.options,
            **given,
        )

    def policy(self, env: SchedulingTorchRL) -> PolicyNetwork:
        """A freshly drawn network. Weights are drawn on the CPU, so that a seed's are the same on every device."""
        return self.policy_for(env.simulator)

    def policy_for(self, simulator: TurnSimulator) -> PolicyNetwork:
        """A freshly drawn network for what a simulator shows, or for the network's own metagraph."""
        sizes = self.config.policy.for_slots(slots_of(simulator.graph, simulator.arrays))
        return sizes.build(sizes.metagraph(simulator.graph)).to(pick_device(self.config.device))

    def critic(self, env: SchedulingTorchRL, sizes: HetGATConfig) -> HetGATCritic:
        """A freshly drawn value function, likewise."""
        critic = HetGATCritic(env.simulator.graph, width=sizes.width, heads=sizes.heads, layers=sizes.layers)
        return critic.to(pick_device(self.config.device))


class AlgorithmConfig:
    """Settings of an algorithm; subclasses are frozen msgspec structs with `tag_field="name"` and the name as tag."""

    __slots__ = ()
    __struct_config__: ClassVar[Any]

    @classmethod
    def algorithm_name(cls) -> str:
        """The name under which the algorithm is registered."""
        return str(cls.__struct_config__.tag)

    def build(self, setup: Setup) -> tuple[Collector, Learner]:
        """What collects experience and what learns from it, with freshly drawn networks."""
        raise NotImplementedError(type(self).__name__)

    def knowledge(self, config: TrainConfig) -> list[str]:
        """What training uses beyond the policy's view, in words; mostly nothing."""
        return []


@cache
def algorithms() -> Mapping[str, type[AlgorithmConfig]]:
    """The registered algorithms by name, sorted."""
    package = import_module("marl_sched.train.algorithms")
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        import_module(module.name)
    for entry in entry_points(group=GROUP):
        entry.load()
    known = sorted(_named(AlgorithmConfig), key=lambda config: config.algorithm_name())
    return {config.algorithm_name(): config for config in known}


def _named(base: type[AlgorithmConfig]) -> list[type[AlgorithmConfig]]:
    """The subclasses that name an algorithm by their tag; others are what several algorithms share."""
    found: list[type[AlgorithmConfig]] = []
    for config in base.__subclasses__():
        if config.__struct_config__.tag is not None:
            found.append(config)
        found += _named(config)
    return found


def algorithm_config(content: Mapping[str, Any]) -> AlgorithmConfig:
    """The settings that a configuration describes: `{"name": NAME, **settings}`.

    Raises UnknownNameError for an algorithm that is not registered, msgspec.ValidationError for settings that are
    missing, unknown or outside their bounds.
    """
    name = content.get(NAME)
    if name not in algorithms():
        raise UnknownNameError("algorithm", str(name), algorithms())
    try:
        return msgspec.convert(content, algorithms()[str(name)])
    except msgspec.ValidationError as error:
        reason, _, where = str(error).partition(" - at `$")
        raise msgspec.ValidationError(f"{reason} - at `$.algorithm{where.rstrip('`')}`") from error

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
from marl_sched.errors import UnknownNameError
from marl_sched.train.collect import Collector, InstanceSource, SegmentCollector
from marl_sched.train.curriculum import EpisodeLength
from marl_sched.train.device import pick_device
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

    def environment(self, *, rows: int, episodes: int = 1) -> SchedulingTorchRL:
        """`rows` training episodes at once, each instance played `episodes` times."""
        config = self.config
        domain, scales = get_domain(config.env.name), config.env.scales
        return SchedulingTorchRL(
            domain,
            batch_size=rows,
            scale=max(scales, key=list(domain.scales).index),
            source=InstanceSource(domain, scales, seed=config.seed, rows=rows, episodes=episodes),
            view=config.make_view(),
            objective=config.env.objective,
            horizon=2 * self.length.longest,  # cuts come before the end, so that a state at a cut still has a value
            seed=config.seed,
            **config.env.options,
        )

    def segments(self, *, rows: int, turns: int, central: bool) -> SegmentCollector:
        """A collector of `turns` turns of every row for each update."""
        return SegmentCollector(self.environment(rows=rows), turns=turns, length=self.length(0), central=central)

    def policy(self, env: SchedulingTorchRL) -> PolicyNetwork:
        """A freshly drawn network. Weights are drawn on the CPU, so that a seed's are the same on every device."""
        simulator = env.simulator
        sizes = self.config.policy.for_slots(slots_of(simulator.graph, simulator.arrays))
        return sizes.build(simulator.graph).to(pick_device(self.config.device))

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
    known = sorted(AlgorithmConfig.__subclasses__(), key=lambda config: config.algorithm_name())
    return {config.algorithm_name(): config for config in known}


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

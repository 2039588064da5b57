"""Networks by name. A network costs one module: its class and, beside it, the struct of its sizes.

That struct, a subclass of `NetworkConfig`, is what `configs/policy/NAME.yaml` may hold, the `sizes` of a policy's card,
and the network's registration. Modules of this package are found by being here, and so are those of a package
`networks` in a domain's room of `marl_sched.agents`, which are imported when a network is asked for that is not here. A
distribution that brings a network of its own names its module in the entry point group `marl_sched.networks`, and gives
its options on the command line (`policy.name=NAME`).
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, Self

import msgspec

from marl_sched.errors import UnknownNameError
from marl_sched.graph import GraphSpec

if TYPE_CHECKING:
    from marl_sched.agents.networks.network import PolicyNetwork

GROUP = "marl_sched.networks"
ARCHITECTURE = "architecture"  # under which a card has the network's name
NAME = "name"  # under which a configuration has it


class NetworkConfig:
    """Sizes of a network; subclasses are frozen msgspec structs with `tag_field="name"` and the name as their tag."""

    __slots__ = ()
    __struct_config__: ClassVar[Any]

    @classmethod
    def network_name(cls) -> str:
        """The name under which the network is registered."""
        return str(cls.__struct_config__.tag)

    @property
    def memory_size(self) -> int:
        """Numbers that an agent carries from one of its decisions to the next; most networks carry none."""
        return 0

    def build(self, graph: GraphSpec) -> PolicyNetwork:
        """An untrained network for a metagraph; torch's generator draws its weights."""
        raise NotImplementedError(type(self).__name__)

    @property
    def planner_options(self) -> tuple[str, ...]:
        """Names of options of what plays the network, where it plans whole rounds (PlannerNetwork.planner)."""
        return ()

    def metagraph(self, graph: GraphSpec) -> GraphSpec:
        """The metagraph that the network reads, for a domain whose turns show `graph`; mostly that one."""
        return graph

    def for_slots(self, slots: Mapping[str, int]) -> Self:
        """These sizes for observations with that many slots (node type -> slots); most networks read any number."""
        return self

    def as_card(self) -> dict[str, Any]:
        """The sizes as a policy's card holds them."""
        content = msgspec.to_builtins(self)
        return {ARCHITECTURE: content.pop(NAME), **content}


@cache
def _general() -> Mapping[str, type[NetworkConfig]]:
    """The networks of this package and of other distributions by name."""
    _import_all("marl_sched.agents.networks")
    for entry in entry_points(group=GROUP):
        entry.load()
    return {config.network_name(): config for config in _subclasses()}


@cache
def networks() -> Mapping[str, type[NetworkConfig]]:
    """All registered networks by name, sorted."""
    _general()
    rooms = import_module("marl_sched.agents")
    for room in pkgutil.iter_modules(rooms.__path__, f"{rooms.__name__}."):
        if room.ispkg and find_spec(f"{room.name}.networks") is not None:
            _import_all(f"{room.name}.networks")
    return {config.network_name(): config for config in sorted(_subclasses(), key=lambda c: c.network_name())}


def _import_all(package: str) -> None:
    for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
        import_module(module.name)


def network_config(content: Mapping[str, Any], field: str = "policy") -> NetworkConfig:
    """The sizes that a configuration describes: `{"name": NAME, **sizes}`.

    Raises UnknownNameError for a network that is not registered, msgspec.ValidationError, which names `field`, for
    sizes that are missing, unknown or outside their bounds.
    """
    given = dict(content)
    name = given.pop(NAME, None)
    known = _general() if name in _general() else networks()
    if name not in known:
        raise UnknownNameError("network", str(name), known)
    try:
        return msgspec.convert({NAME: name, **given}, known[name])
    except msgspec.ValidationError as error:
        reason, _, where = str(error).partition(" - at `$")
        raise msgspec.ValidationError(f"{reason} - at `$.{field}{where.rstrip('`')}`") from error


def config_of_card(sizes: Mapping[str, Any]) -> NetworkConfig:
    """The sizes that a card holds; raises as `network_config`."""
    content = dict(sizes)
    return network_config({NAME: content.pop(ARCHITECTURE, None), **content}, "sizes")


def _subclasses() -> list[type[NetworkConfig]]:
    return NetworkConfig.__subclasses__()

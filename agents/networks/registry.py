"""Networks by name. A network costs one module: its class and, beside it, the struct of its sizes.

That struct, a subclass of `NetworkConfig`, is what `configs/policy/NAME.yaml` may hold, the `sizes` of a policy's card,
and the network's registration. Modules of this package are found by being here; a distribution that brings a network
of its own names its module in the entry point group `marl_sched.networks`, and gives its options on the command line
(`policy.name=NAME`).
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
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

    def for_slots(self, slots: Mapping[str, int]) -> Self:
        """These sizes for observations with that many slots (node type -> slots); most networks read any number."""
        return self

    def as_card(self) -> dict[str, Any]:
        """The sizes as a policy's card holds them."""
        content = msgspec.to_builtins(self)
        return {ARCHITECTURE: content.pop(NAME), **content}


@cache
def networks() -> Mapping[str, type[NetworkConfig]]:
    """The registered networks by name, sorted."""
    package = import_module("marl_sched.agents.networks")
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        import_module(module.name)
    for entry in entry_points(group=GROUP):
        entry.load()
    return {config.network_name(): config for config in sorted(_subclasses(), key=lambda c: c.network_name())}


def network_config(content: Mapping[str, Any], field: str = "policy") -> NetworkConfig:
    """The sizes that a configuration describes: `{"name": NAME, **sizes}`.

    Raises UnknownNameError for a network that is not registered, msgspec.ValidationError, which names `field`, for
    sizes that are missing, unknown or outside their bounds.
    """
    given = dict(content)
    name = given.pop(NAME, None)
    if name not in networks():
        raise UnknownNameError("network", str(name), networks())
    try:
        return msgspec.convert({NAME: name, **given}, networks()[name])
    except msgspec.ValidationError as error:
        reason, _, where = str(error).partition(" - at `$")
        raise msgspec.ValidationError(f"{reason} - at `$.{field}{where.rstrip('`')}`") from error


def config_of_card(sizes: Mapping[str, Any]) -> NetworkConfig:
    """The sizes that a card holds; raises as `network_config`."""
    content = dict(sizes)
    return network_config({NAME: content.pop(ARCHITECTURE, None), **content}, "sizes")


def _subclasses() -> list[type[NetworkConfig]]:
    return NetworkConfig.__subclasses__()

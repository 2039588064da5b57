"""What an agent needs of a domain that decides without Numba: a light agent (comms/PROTOCOL.md).

A robot does not carry a training stack. A domain's simulator and the kernels that observe it are compiled by Numba, so
a domain whose agents are to do without has a second, small declaration: their local state read in NumPy, and rules in
NumPy. It stands in `marl_sched.envs.LIGHT_DOMAINS`, or is an entry point of the group `marl_sched.light_domains`:

    [project.entry-points."marl_sched.light_domains"]
    couriers = "couriers.light:COURIERS"
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from marl_sched.errors import MarlSchedError
from marl_sched.plugins import import_object, load_offered, offered

if TYPE_CHECKING:
    from marl_sched.domain_parts import LocalState
    from marl_sched.graph import GraphSpec

GROUP = "marl_sched.light_domains"
Runtime = Literal["torch", "onnx"]  # what runs a network: PyTorch or onnxruntime


@dataclass(frozen=True, kw_only=True)
class LightDomain:
    """A domain as a light agent sees it; what it imports does not import Numba.

    Attributes:
        name, agent_prefix: those of the Domain.
        local_state: (frame, agent) -> what one agent knows, see Telemetry.local_state.
        schedulers: `package.module:attribute` of a table of rules, name -> factory, with the same choices as the
            domain's rules of these names.
        pressing: see Domain.pressing.
    """

    name: str
    agent_prefix: str
    local_state: Callable[[bytes, int], LocalState]
    schedulers: str
    pressing: Callable[[GraphSpec, Mapping[str, np.ndarray]], np.ndarray] | None = None

    def rules(self) -> Mapping[str, Callable[[], Any]]:
        """The table of rules."""
        found: Mapping[str, Callable[[], Any]] = import_object(self.schedulers)
        return found

    def agent_name(self, agent: int) -> str:
        """`crew_3` for agent 3 of a domain whose agents are crews."""
        return f"{self.agent_prefix}_{agent}"


def light_domain(name: str) -> LightDomain | None:
    """The light declaration of the domain of that name; None if it has none.

    Raises MarlSchedError for an entry point that does not lead to one of its name.
    """
    from marl_sched.envs import LIGHT_DOMAINS

    found: Any = None
    if name in LIGHT_DOMAINS:
        found = import_object(LIGHT_DOMAINS[name])
    elif name in (points := offered(GROUP)):
        found = load_offered(points[name])
    if found is not None and (not isinstance(found, LightDomain) or found.name != name):
        raise MarlSchedError(f"entry point {name} of {GROUP}: expected a LightDomain of that name, got {found!r}")
    return found

"""DeepRM (Mao et al. 2016) as the dissertation adapts it (section 6.5.1): the whole problem as one flat vector.

The features of all planes, all crews and the state are concatenated, with zeros in the slots that an instance does
not fill, and a feed-forward network gives one logit for each slot. Its weights therefore belong to one number of
planes and crews, the largest of a scale, and there is a model for every scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

import torch
from msgspec import Struct, structs
from torch import Tensor

from marl_sched.agents.networks.network import (
    PolicyNetwork,
    explore_at_first,
    fully_connected,
    mask_logits,
    visible_features,
)
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Layers, Slots, Width
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import STATE, GraphSpec


class DeepRMConfig(
    NetworkConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="deeprm"
):
    """Sizes of a DeepRM network: features of a layer, layers, and the slots of every node type that it reads.

    A configuration leaves the slots empty; they are those of the largest of a run's scales (`for_slots`).
    """

    hidden: Width
    layers: Layers
    slots: dict[str, Slots] = {}

    def build(self, graph: GraphSpec) -> DeepRMNetwork:
        """See NetworkConfig."""
        return DeepRMNetwork(graph, slots=self.slots, hidden=self.hidden, layers=self.layers)

    def for_slots(self, slots: Mapping[str, int]) -> Self:
        """These sizes for observations with that many slots (node type -> slots)."""
        return structs.replace(self, slots=dict(slots))


class DeepRMNetwork(PolicyNetwork):
    """Fully connected layers from all features to a logit for each slot.

    Args:
        spec: the metagraph.
        slots: node type -> number of padded slots, for every type of the metagraph.
        hidden: width of the layers between; the dissertation's is 64 for small, 128 for medium and large.
        layers: number of fully connected layers, ReLU between them.

    Raises InvalidOptionError if `slots` names other node types than the metagraph.
    """

    permutation_equivariant = False
    config: DeepRMConfig

    def __init__(self, spec: GraphSpec, *, slots: Mapping[str, int], hidden: int = 64, layers: int = 4) -> None:
        super().__init__()
        names = [node.name for node in spec.nodes]
        if sorted(slots) != sorted(names):
            raise InvalidOptionError(f"slots: expected a number for each of {sorted(names)}, got {sorted(slots)}")
        self.spec = spec
        self.config = DeepRMConfig(hidden=hidden, layers=layers, slots=dict(slots))
        n_in = sum(slots[node.name] * len(node.features) for node in spec.nodes) + len(spec.state_features)
        self.stack = fully_connected(n_in, hidden, slots[spec.decision_of], layers)
        explore_at_first(self.stack)

    def reads(self, slots: Mapping[str, int]) -> bool:
        """Only those that it was made for."""
        return dict(slots) == self.config.slots

    def forward(self, observation: Mapping[str, Tensor], weights: None = None) -> Tensor:
        """Logits (B, n_actions), see PolicyNetwork.

        Raises InvalidOptionError for an observation with other numbers of slots.
        """
        found = {name: observation[name].shape[1] for name in self.config.slots}
        if not self.reads(found):
            raise InvalidOptionError(
                f"observation: a DeepRM network for slots {_counted(self.config.slots)} cannot read one with "
                f"{_counted(found)}; every scale needs a model of its own"
            )
        dtype = next(self.parameters()).dtype
        flat = [visible_features(observation, node.name, dtype).flatten(1) for node in self.spec.nodes]
        return mask_logits(self.stack(torch.cat([*flat, observation[STATE].to(dtype)], dim=1)), observation)


def _counted(slots: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in slots.items())

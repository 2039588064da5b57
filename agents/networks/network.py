"""What a policy's network is to everything that trains, saves or plays it: observations in, logits out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from marl_sched.agents.networks.registry import NetworkConfig
from marl_sched.graph import ACTION_MASK, ArraySpec, GraphSpec


class PolicyNetwork(nn.Module, ABC):
    """Logits over the decision nodes of an observation.

    Attributes:
        permutation_equivariant: whether permuting a type's nodes permutes the logits and no weight depends on how
            many there are, so that hidden nodes may be cut out of an observation.
        spec: the metagraph that it was made for.
        config: its sizes, from which an untrained network like it can be built.
    """

    permutation_equivariant: ClassVar[bool]
    spec: GraphSpec
    config: NetworkConfig

    @property
    def sizes(self) -> dict[str, Any]:
        """What its card holds of its sizes."""
        return self.config.as_card()

    def weights(self) -> Any:
        """What can be prepared once for many forward passes with fixed parameters; here nothing."""
        return None

    def reads(self, slots: Mapping[str, int]) -> bool:
        """Whether it can read observations with these numbers of slots (node type -> slots); this one any."""
        return True

    @abstractmethod
    def forward(self, observation: Mapping[str, Tensor], weights: Any = None) -> Tensor:
        """Logits (B, n_actions) from the tensors of an observation (marl_sched.graph, with batch axis).

        `weights` are those of the method `weights`, prepared here if not given. Actions outside the action mask
        get the dtype's lowest finite number. Hidden and padded entries may hold anything, NaN included.
        """


def slots_of(spec: GraphSpec, arrays: Mapping[str, ArraySpec]) -> dict[str, int]:
    """Node type -> number of slots that observations with these arrays have."""
    return {node.name: arrays[node.name].shape[0] for node in spec.nodes}


def fully_connected(n_in: int, hidden: int, n_out: int, layers: int) -> nn.Sequential:
    """`layers` fully connected layers with ReLU between them, all but the last `hidden` wide."""
    widths = [n_in, *[hidden] * (layers - 1), n_out]
    stack: list[nn.Module] = []
    for before, after in pairwise(widths):
        stack += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*stack[:-1])


def explore_at_first(network: nn.Module) -> None:
    """Draw a network's last layer small: an untrained policy chooses among all legal actions nearly alike."""
    *_, weight, bias = network.parameters()
    nn.init.normal_(weight, std=0.01)
    nn.init.zeros_(bias)


def visible_features(observation: Mapping[str, Tensor], node: str, dtype: torch.dtype) -> Tensor:
    """The features (B, n, f) of a node type, zero where hidden or padded."""
    hidden = observation[f"{node}_mask"] == 0
    return observation[node].to(dtype).masked_fill(hidden[..., None], 0.0)


def mask_logits(logits: Tensor, observation: Mapping[str, Tensor]) -> Tensor:
    """Logits with the lowest finite number outside the action mask.

    Its probability is exactly zero, and p log p is zero where -inf would make it NaN.
    """
    return torch.where(observation[ACTION_MASK] != 0, logits, torch.finfo(logits.dtype).min)

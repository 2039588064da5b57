"""What a policy's network is to everything that trains, saves or plays it: observations in, logits out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from marl_sched.agents.networks.registry import NetworkConfig
from marl_sched.graph import ACTION_MASK, ArraySpec, GraphSpec

MEMORY = "memory"  # of an agent, beside its observation


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


class RecurrentNetwork(PolicyNetwork):
    """A network with which an agent carries a memory from one of its decisions to the next.

    It works in three steps, of which the middle one alone goes through an agent's decisions one by one:

        inputs, nodes = encode(observation)
        memory = advance(inputs, memory)
        logits = score(nodes, memory, observation)

    An empty memory is zeros.

    Attributes:
        memory_size: numbers that an agent remembers; those of `config`.
    """

    @property
    def memory_size(self) -> int:
        """Numbers that an agent remembers."""
        return self.config.memory_size

    @abstractmethod
    def encode(self, observation: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """What goes into the memory, float (B, n), and the decision nodes' features, float (B, n_actions, m)."""

    @abstractmethod
    def advance(self, inputs: Tensor, memory: Tensor) -> Tensor:
        """Memories float (B, memory_size) after a decision, from those before it and the inputs (B, n)."""

    @abstractmethod
    def score(self, nodes: Tensor, memory: Tensor, observation: Mapping[str, Tensor]) -> Tensor:
        """Logits (B, n_actions), see PolicyNetwork.forward, from features (B, n_actions, m) and new memories."""

    def recur(self, observation: Mapping[str, Tensor], memory: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, n_actions) and new memories of one decision of each of B agents; memory (B, memory_size)."""
        inputs, nodes = self.encode(observation)
        after = self.advance(inputs, memory)
        return self.score(nodes, after, observation), after

    def unroll(self, observation: Mapping[str, Tensor], memory: Tensor, place: Tensor) -> Tensor:
        """Logits (N, n_actions) of N decisions in sequences, each with the memory that the one before it left.

        Decisions stand in the order of torch's PackedSequence: the first of all sequences, then the second, ..., and
        longer sequences before shorter ones. `place` int64 (N,) is 0 for the first of a sequence, 1 for the second,
        ...; `memory` (N, memory_size) is read where it is 0. Gradients flow back to the beginning of each sequence.
        """
        inputs, nodes = self.encode(observation)
        counts = torch.bincount(place).tolist()
        after, memories = memory[: counts[0]].to(inputs.dtype), []
        for part in inputs.split(counts):
            after = self.advance(part, after[: len(part)])
            memories.append(after)
        return self.score(nodes, torch.cat(memories), observation)

    def forward(self, observation: Mapping[str, Tensor], weights: None = None) -> Tensor:
        """Logits (B, n_actions) of observations with the entry `memory`, float32 (B, memory_size)."""
        return self.recur(observation, observation[MEMORY])[0]


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


def scores_beside(q: nn.Sequential, nodes: Tensor, context: Tensor) -> Tensor:
    """The scores (B, n) that fully connected layers give nodes (B, n, m), each beside its graph's context (B, 1, k).

    The first layer's product with the context is the same for all nodes of a graph, and is made once.
    """
    first, rest = cast(nn.Linear, q[0]), q[1:]
    of_node, of_context = first.weight.split([nodes.shape[-1], context.shape[-1]], dim=1)
    return rest(functional.linear(nodes, of_node, first.bias) + functional.linear(context, of_context)).squeeze(-1)


def mask_logits(logits: Tensor, observation: Mapping[str, Tensor]) -> Tensor:
    """Logits with the lowest finite number outside the action mask.

    Its probability is exactly zero, and p log p is zero where -inf would make it NaN.
    """
    return torch.where(observation[ACTION_MASK] != 0, logits, torch.finfo(logits.dtype).min)

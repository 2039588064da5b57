"""A network on many observations at once, in pieces that are quick to compute.

Slots that no row needs are cut off: of a large fleet a crew with a local view sees a tenth. And activations of tens
of megabytes leave the processor's cache and are fresh memory in every layer, so a big batch is cut into blocks of
rows. Small blocks pay the fixed price of the hundred operations of a forward pass too often.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from marl_sched.agents.networks.compaction import compacted, slots_needed
from marl_sched.agents.networks.network import MEMORY, PolicyNetwork, RecurrentNetwork
from marl_sched.graph import ACTION_MASK

_Pass = Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]]
BLOCK_NODES = 24_576  # of a block, all types together: 140 graphs of 176 nodes, 500 of 49
WORTH_COMPACTING = 0.9  # where more of the slots are needed, moving nodes costs more than it saves


def logits_in_blocks(network: PolicyNetwork, observation: Mapping[str, Tensor], weights: Any) -> Tensor:
    """Logits (B, n_actions) of a batch of observations, within 1e-5 of the network's on the whole batch.

    Actions outside the action mask get the dtype's lowest finite number. `weights` are `network.weights()`.
    """

    def logits(smaller: Mapping[str, Tensor]) -> tuple[Tensor]:
        return (network(smaller, weights),)

    return torch.cat([found[0] for found in _in_blocks(network, observation, logits)])


def recurred_in_blocks(
    network: RecurrentNetwork, observation: Mapping[str, Tensor], memory: Tensor
) -> tuple[Tensor, Tensor]:
    """Logits (B, n_actions) and new memories (B, memory_size) of a batch, both within 1e-5, likewise."""

    def recurred(smaller: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        return network.recur(smaller, smaller[MEMORY])

    logits, after = zip(*_in_blocks(network, {**observation, MEMORY: memory}, recurred), strict=True)
    return torch.cat(logits), torch.cat(after)


def _in_blocks(network: PolicyNetwork, observation: Mapping[str, Tensor], of: _Pass) -> Iterator[tuple[Tensor, ...]]:
    """What a pass gives for one block of rows after the other, with logits first."""
    needed = (
        slots_needed(network.spec, observation) if network.permutation_equivariant else _slots(network, observation)
    )
    rows = len(observation[ACTION_MASK])
    blocks = min(rows, -(-rows * sum(needed.values()) // BLOCK_NODES))
    split = {name: values.tensor_split(blocks) for name, values in observation.items()}
    for i in range(blocks):
        yield _compacted_pass(network, {name: pieces[i] for name, pieces in split.items()}, of)


def _compacted_pass(network: PolicyNetwork, observation: Mapping[str, Tensor], of: _Pass) -> tuple[Tensor, ...]:
    if not network.permutation_equivariant:
        return of(observation)
    needed = slots_needed(network.spec, observation)
    if sum(needed.values()) > WORTH_COMPACTING * sum(_slots(network, observation).values()):
        return of(observation)
    smaller, names = compacted(network.spec, observation, needed)
    found, *others = of(smaller)
    logits = found.new_full(observation[ACTION_MASK].shape, torch.finfo(found.dtype).min)
    return logits.scatter_(1, names, found), *others


def _slots(network: PolicyNetwork, observation: Mapping[str, Tensor]) -> dict[str, int]:
    return {node.name: observation[f"{node.name}_mask"].shape[1] for node in network.spec.nodes}

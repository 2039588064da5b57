"""A network on many observations at once, in pieces that are quick to compute.

Slots that no row needs are cut off: of a large fleet a crew with a local view sees a tenth. And activations of tens
of megabytes leave the processor's cache and are fresh memory in every layer, so a big batch is cut into blocks of
rows. Small blocks pay the fixed price of the hundred operations of a forward pass too often.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from marl_sched.agents.networks.compaction import compacted, slots_needed
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.graph import ACTION_MASK

BLOCK_NODES = 24_576  # of a block, all types together: 140 graphs of 176 nodes, 500 of 49
WORTH_COMPACTING = 0.9  # where more of the slots are needed, moving nodes costs more than it saves


def logits_in_blocks(network: PolicyNetwork, observation: Mapping[str, Tensor], weights: Any) -> Tensor:
    """Logits (B, n_actions) of a batch of observations, within 1e-5 of the network's on the whole batch.

    Actions outside the action mask get the dtype's lowest finite number. `weights` are `network.weights()`.
    """
    needed = (
        slots_needed(network.spec, observation) if network.permutation_equivariant else _slots(network, observation)
    )
    rows = len(observation[ACTION_MASK])
    blocks = min(rows, -(-rows * sum(needed.values()) // BLOCK_NODES))
    split = {name: values.tensor_split(blocks) for name, values in observation.items()}
    parts = [_logits(network, {name: pieces[i] for name, pieces in split.items()}, weights) for i in range(blocks)]
    return torch.cat(parts)


def _logits(network: PolicyNetwork, observation: Mapping[str, Tensor], weights: Any) -> Tensor:
    if not network.permutation_equivariant:
        return network(observation, weights)
    needed = slots_needed(network.spec, observation)
    if sum(needed.values()) > WORTH_COMPACTING * sum(_slots(network, observation).values()):
        return network(observation, weights)
    smaller, names = compacted(network.spec, observation, needed)
    found = network(smaller, weights)
    logits = found.new_full(observation[ACTION_MASK].shape, torch.finfo(found.dtype).min)
    return logits.scatter_(1, names, found)


def _slots(network: PolicyNetwork, observation: Mapping[str, Tensor]) -> dict[str, int]:
    return {node.name: observation[f"{node.name}_mask"].shape[1] for node in network.spec.nodes}

"""A recurrent policy: what an agent sees goes into an LSTM cell of its own, which decides beside each action's node.

    e_m = f_type(x_m)                                            every visible node
    z = mean of e_m over each type's visible nodes || x_state    what the agent sees, in one vector
    h, c = LSTMCell(z, (h, c))                                   Hochreiter and Schmidhuber 1997
    q_m = q( e_m || h )                                          every decision node m
    p(m) = softmax over legal m of q_m

The weights are those of all agents, the memory (h, c) is each agent's: it goes from one of its decisions to the next
and through no other agent's. No weight depends on how many nodes there are, so one network serves every scale.
Relations are not read; which node is the acting agent's is told by the domain's features, if they do.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from msgspec import Struct
from torch import Tensor, nn

from marl_sched.agents.networks.network import (
    RecurrentNetwork,
    explore_at_first,
    fully_connected,
    mask_logits,
    scores_beside,
    visible_features,
)
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Layers, Width
from marl_sched.graph import STATE, GraphSpec


class LstmConfig(
    NetworkConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="lstm"
):
    """Sizes of a recurrent network: features of a layer, layers of f and of q, units of the LSTM cell."""

    hidden: Width
    layers: Layers
    units: Width

    @property
    def memory_size(self) -> int:
        """Output h and cell state c."""
        return 2 * self.units

    def build(self, graph: GraphSpec) -> LstmNetwork:
        """See NetworkConfig."""
        return LstmNetwork(graph, hidden=self.hidden, layers=self.layers, units=self.units)


class LstmNetwork(RecurrentNetwork):
    """Node embeddings f, their mean by type, an LSTM cell and scores q; see the module's page.

    A memory is the cell's output h, then its state c.

    Args:
        spec: the metagraph.
        hidden: width of every layer of f and q, and of the embeddings.
        layers: fully connected layers of f and of q, ReLU between them.
        units: of the cell.
    """

    permutation_equivariant = True
    config: LstmConfig

    def __init__(self, spec: GraphSpec, *, hidden: int = 32, layers: int = 2, units: int = 32) -> None:
        super().__init__()
        self.spec = spec
        self.config = LstmConfig(hidden=hidden, layers=layers, units=units)
        self.f = nn.ModuleDict(
            {node.name: fully_connected(len(node.features), hidden, hidden, layers) for node in spec.nodes}
        )
        self.cell = nn.LSTMCell(len(spec.nodes) * hidden + len(spec.state_features), units)
        self.q = fully_connected(hidden + units, hidden, 1, layers)
        explore_at_first(self.q)

    def encode(self, observation: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """What the agent sees in one vector, and the embeddings of the nodes that decisions are on."""
        dtype = self.cell.weight_ih.dtype
        embedded = {
            node.name: self.f[node.name](visible_features(observation, node.name, dtype)) for node in self.spec.nodes
        }
        means = [_visible_mean(nodes, observation[f"{name}_mask"] != 0) for name, nodes in embedded.items()]
        seen = torch.cat([*means, observation[STATE].to(dtype)], dim=1)
        return seen, embedded[self.spec.decision_of]

    def advance(self, inputs: Tensor, memory: Tensor) -> Tensor:
        """One step of the cell."""
        return torch.cat(self.cell(inputs, tuple(memory.chunk(2, dim=1))), dim=1)

    def score(self, nodes: Tensor, memory: Tensor, observation: Mapping[str, Tensor]) -> Tensor:
        """The scores q, masked."""
        output = memory[:, None, : self.config.units]
        return mask_logits(scores_beside(self.q, nodes, output), observation)


def _visible_mean(nodes: Tensor, visible: Tensor) -> Tensor:
    """The mean (B, m) of the features (B, n, m) of visible nodes, bool (B, n); 0 where none is."""
    total = nodes.masked_fill(~visible[..., None], 0.0).sum(1)
    return total / visible.sum(1, keepdim=True).clamp(min=1)

"""Stacks of HetGAT layers with a head: the policy's logits over decisions, and a critic's value.

No weight depends on the graph's size: the same network runs on any number of planes, crews, tasks or agents.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import cast

import torch
from msgspec import Struct
from torch import Tensor, nn

from marl_sched.agents.networks.hetgat.inputs import GraphInputs, read_graph
from marl_sched.agents.networks.hetgat.layer import HetGATLayer, LayerWeights, Merge
from marl_sched.agents.networks.network import PolicyNetwork, explore_at_first, mask_logits
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Heads, Layers, Width
from marl_sched.graph import DECISION, STATE, GraphSpec

EncoderWeights = tuple[LayerWeights, ...]


class HetGATEncoder(nn.Module):
    """Layers that turn a graph into features of the node types `outputs`.

    All layers but the last concatenate their heads, the last averages them, so a node ends with `width`
    features. What no output depends on has no parameters and is not computed.

    Args:
        spec: the metagraph.
        width: features per head.
        heads: heads per layer.
        layers: number of layers, at least 1.
        outputs: node types, `state` and `decision` among them.
    """

    def __init__(self, spec: GraphSpec, *, width: int, heads: int, layers: int, outputs: Collection[str]) -> None:
        super().__init__()
        self.spec = spec
        sizes = {node.name: len(node.features) for node in spec.nodes}
        sizes |= {STATE: len(spec.state_features), DECISION: 0}
        stack: list[HetGATLayer] = []
        for wanted in _needed(spec, outputs, layers):
            merge: Merge = "mean" if len(stack) == layers - 1 else "concat"
            layer = HetGATLayer(spec, sizes, width=width, heads=heads, merge=merge, outputs=wanted)
            sizes = {name: layer.out_size if name in wanted else 0 for name in sizes}
            stack.append(layer)
        self.layers = nn.ModuleList(stack)
        self._relations = {relation.key: relation for layer in stack for relation in layer.relations}

    def weights(self) -> EncoderWeights:
        """All layers' weights as they are applied (`HetGATLayer.weights`), for passes with fixed parameters."""
        return tuple(layer.weights() for layer in cast(Iterable[HetGATLayer], self.layers))

    def forward(
        self, observation: Mapping[str, Tensor], weights: EncoderWeights | None = None
    ) -> tuple[dict[str, Tensor], GraphInputs]:
        """Features (B, n, width) of the output node types, (B, 1, width) for the state, and the graph read."""
        graph = read_graph(self.spec, observation, self._relations.values(), next(self.parameters()).dtype)
        nodes = graph.nodes
        for layer, applied in zip(self.layers, weights or self.weights(), strict=True):
            nodes = layer(graph, nodes, applied)
        return nodes, graph


class HetGATConfig(
    NetworkConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="hetgat"
):
    """Sizes of a HetGAT network: features per head, heads per layer, layers."""

    width: Width
    heads: Heads
    layers: Layers

    def build(self, graph: GraphSpec) -> HetGATNetwork:
        """See NetworkConfig."""
        return HetGATNetwork(graph, width=self.width, heads=self.heads, layers=self.layers)


class HetGATNetwork(PolicyNetwork):
    """A policy's network: logits over the decision nodes.

    Args:
        spec: the metagraph.
        width, heads, layers: sizes of the encoder; the dissertation's are 32, 4 and 3.
    """

    permutation_equivariant = True

    def __init__(self, spec: GraphSpec, *, width: int = 8, heads: int = 4, layers: int = 3) -> None:
        super().__init__()
        self.spec = spec
        self.config = HetGATConfig(width=width, heads=heads, layers=layers)
        self.encoder = HetGATEncoder(spec, width=width, heads=heads, layers=layers, outputs=[DECISION])
        self.readout = nn.Linear(width, 1)
        explore_at_first(self.readout)

    def weights(self) -> EncoderWeights:
        """All layers' weights as they are applied (`HetGATLayer.weights`), for passes with fixed parameters."""
        return self.encoder.weights()

    def forward(self, observation: Mapping[str, Tensor], weights: EncoderWeights | None = None) -> Tensor:
        """Logits (B, n_actions), see PolicyNetwork."""
        nodes, _ = self.encoder(observation, weights)
        return mask_logits(self.readout(nodes[DECISION]).squeeze(-1), observation)


class HetGATCritic(nn.Module):
    """A value function that sums one term for each visible node of the types `summed` and one for the state.

    It sees nothing of a deployed agent's business, so it may be given the full graph and what no node
    carries, such as the time left in the episode.

    Args:
        spec: the metagraph.
        width, heads, layers: sizes of the encoder.
        extra: number of inputs beside the graph, which enter the state's term.
        summed: node types whose nodes have terms, None: all.
    """

    def __init__(
        self,
        spec: GraphSpec,
        *,
        width: int = 8,
        heads: int = 4,
        layers: int = 2,
        extra: int = 0,
        summed: Collection[str] | None = None,
    ) -> None:
        super().__init__()
        self.spec = spec
        names = [node.name for node in spec.nodes] if summed is None else list(summed)
        self.encoder = HetGATEncoder(spec, width=width, heads=heads, layers=layers, outputs=[*names, STATE])
        self.node_terms = nn.ModuleDict({name: nn.Linear(width, 1) for name in names})
        hidden = width * heads
        last = nn.Linear(hidden, 1)
        self.state_term = nn.Sequential(nn.Linear(width + extra, hidden), nn.ReLU(), last)
        # The sum over a fleet of random terms would start far from any return.
        for parameter in (*self.node_terms.parameters(), *last.parameters()):
            nn.init.zeros_(parameter)

    def forward(self, observation: Mapping[str, Tensor], extra: Tensor | None = None) -> Tensor:
        """Values (B,) from an observation's tensors and, if the critic has them, `extra` inputs (B, n_extra)."""
        nodes, graph = self.encoder(observation)
        state = nodes[STATE].squeeze(1)
        value = self.state_term(state if extra is None else torch.cat([state, extra], dim=-1)).squeeze(-1)
        for name, term in self.node_terms.items():
            value = value + torch.where(graph.masks[name], term(nodes[name]).squeeze(-1), 0.0).sum(-1)
        return value


def _needed(spec: GraphSpec, outputs: Collection[str], layers: int) -> list[set[str]]:
    """The node types that each layer has to compute, first layer first."""
    needed = [set(outputs)]
    while len(needed) < layers:
        sources = {relation.source for relation in spec.relations if relation.target in needed[0]}
        needed.insert(0, needed[0] | sources)
    return needed

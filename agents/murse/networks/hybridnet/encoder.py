"""The HetGAT encoder with deep edge embeddings (dissertation, sections 4.3.2 and 5.4).

For a node i of type T, with H heads of width W:

    h'_i = LayerNorm(ReLU( W_T h_i + b_T + sum over relations r into T of sum_j alpha_ij (W_r h_j + W_edge,r z_ij) ))
    z'_ij = ReLU( V_r z_ij + v_r )

alpha_ij is the softmax over sources j of LeakyReLU(a_r . [W_T h_i || W_r h_j || W_edge,r z_ij]). The second line is
improvement 2 of section 5.4.1: every layer has edge embeddings of its own, made from those of the layer before. The
first ones are the relations' attributes. Improvement 1, the re-routed network, is in the relations `temporal` and
`aug`; what ties tasks to the placeholders s0 and f0 are features of the tasks (the module `features` beside this one).
Heads are concatenated, in the last layer averaged. The normalisation is not in the dissertation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from marl_sched.agents.murse.networks.hybridnet.features import (
    AGENT_FEATURES,
    LOCATION_FEATURES,
    PAIR_FEATURES,
    STATE_FEATURES,
    TASK_FEATURES,
    Features,
)
from marl_sched.graph import STATE, GraphSpec, NodeType, Relation

NEGATIVE_SLOPE = 0.2
LOW = -1e9  # added to the attention logit of what is no edge
TASK, AGENT, LOCATION = "task", "agent", "location"
RELATIONS = (
    Relation(TASK, "temporal", TASK, "dense", attention=True, attributes=("bound",)),
    Relation(TASK, "aug", TASK, "dense", attention=True, attributes=("bound",)),
    Relation(TASK, "assigned_to", AGENT, "dense", attention=True, attributes=PAIR_FEATURES),
    Relation(TASK, "take_time", AGENT, "dense", attention=True, attributes=PAIR_FEATURES),
    Relation(AGENT, "use_time", TASK, "dense", attention=True, attributes=PAIR_FEATURES),
    Relation(AGENT, "communicate", AGENT, "all", attention=True),
    Relation(TASK, "located_in", LOCATION, "dense", attention=True),
    Relation(LOCATION, "near", LOCATION, "dense", attention=True),
    Relation(LOCATION, "hosts", TASK, "dense", attention=True),
    Relation(TASK, "in", STATE, "all", attention=True),
    Relation(AGENT, "in", STATE, "all", attention=True),
    Relation(LOCATION, "in", STATE, "all", attention=True),
)
METAGRAPH = GraphSpec(
    nodes=(NodeType(TASK, TASK_FEATURES), NodeType(AGENT, AGENT_FEATURES), NodeType(LOCATION, LOCATION_FEATURES)),
    state_features=STATE_FEATURES,
    relations=RELATIONS,
    decision_of=TASK,
)
NODES = {**{node.name: len(node.features) for node in METAGRAPH.nodes}, STATE: len(STATE_FEATURES)}


class Edges(NamedTuple):
    """Where a relation has edges: `bias` (R, 1, targets, sources), 0 there and very low elsewhere, and `any_source`.

    The latter, (R, 1, targets, 1), is 1 where a target has a source and 0 where it has none.
    """

    bias: Tensor
    any_source: Tensor

    @classmethod
    def of(cls, there: Tensor) -> Edges:
        """From bool (R, targets, sources)."""
        bias = torch.zeros(there.shape).masked_fill_(~there, LOW)
        return cls(bias[:, None], there.any(2)[:, None, :, None].float())


class Graph(NamedTuple):
    """A batch of graphs: features per node type, edges and their attributes (R, targets, sources, k) per relation."""

    nodes: Mapping[str, Tensor]
    edges: Mapping[str, Edges]
    attributes: Mapping[str, Tensor]


def graph_of(features: Features, device: torch.device | None = None) -> Graph:
    """The graphs of a batch of rounds, as tensors."""
    tensors = {name: torch.from_numpy(array).to(device) for name, array in features._asdict().items()}
    real_task, real_agent = tensors["eligible"].any(2), tensors["eligible"].any(1)
    real_place, waits = tensors["located"].any(1), tensors["waits"]
    able, bound, pair = tensors["eligible"], tensors["bound"][..., None], tensors["pair"]
    open_pairs = able & (tensors["task"][..., 0] > 0)[:, :, None]
    edges = {
        "task_temporal_task": waits.transpose(1, 2),
        "task_aug_task": waits,
        "task_assigned_to_agent": tensors["assigned"].transpose(1, 2),
        "task_take_time_agent": open_pairs.transpose(1, 2),
        "agent_use_time_task": open_pairs,
        "agent_communicate_agent": real_agent[:, :, None] & real_agent[:, None],
        "task_located_in_location": tensors["located"].transpose(1, 2),
        "location_near_location": tensors["near"],
        "location_hosts_task": tensors["located"],
        "task_in_state": real_task[:, None],
        "agent_in_state": real_agent[:, None],
        "location_in_state": real_place[:, None],
    }
    attributes = {
        "task_temporal_task": bound.transpose(1, 2),
        "task_aug_task": bound,
        "task_assigned_to_agent": pair.transpose(1, 2),
        "task_take_time_agent": pair.transpose(1, 2),
        "agent_use_time_task": pair,
    }
    nodes = {TASK: tensors["task"], AGENT: tensors["agent"], LOCATION: tensors["location"]}
    made = {key: Edges.of(there) for key, there in edges.items()}
    return Graph({**nodes, STATE: tensors["state"][:, None]}, made, attributes)


class DeepEdgeLayer(nn.Module):
    """One layer; see the page.

    Args:
        sizes: node type -> number of features that come in.
        edge_sizes: key of a relation with attributes -> number of values of its edges' embeddings that come in.
        width: of a head's features.
        heads: how many.
        edge_width: of the edge embeddings that go out.
        merge: whether heads are concatenated; otherwise they are averaged.
    """

    def __init__(
        self,
        sizes: Mapping[str, int],
        edge_sizes: Mapping[str, int],
        *,
        width: int,
        heads: int,
        edge_width: int,
        merge: bool,
    ) -> None:
        super().__init__()
        self.width, self.heads, self.merge = width, heads, merge
        self.out_size = width * heads if merge else width
        self.own = nn.ModuleDict({name: nn.Linear(size, heads * width) for name, size in sizes.items()})
        self.normalise = nn.ModuleDict({name: nn.LayerNorm(self.out_size) for name in sizes})
        self.message, self.edge_message, self.edge = nn.ModuleDict(), nn.ModuleDict(), nn.ModuleDict()
        self.attend = nn.ParameterDict()
        for relation in RELATIONS:
            key = relation.key
            self.message[key] = nn.Linear(sizes[relation.source], heads * width, bias=False)
            parts = 3 if key in edge_sizes else 2
            self.attend[key] = nn.Parameter(torch.empty(parts, heads, width).uniform_(-1, 1) * (6 / (3 * width)) ** 0.5)
            if key in edge_sizes:
                self.edge_message[key] = nn.Linear(edge_sizes[key], heads * width, bias=False)
                self.edge[key] = nn.Linear(edge_sizes[key], edge_width)

    def forward(self, graph: Graph) -> Graph:
        """The graph with new node features (R, n, out_size) and edge embeddings (R, targets, sources, edge_width)."""
        own = {name: self._heads(self.own[name](nodes)) for name, nodes in graph.nodes.items()}
        total = dict(own)
        for relation in RELATIONS:
            total[relation.target] = total[relation.target] + self._messages(relation, graph, own[relation.target])
        nodes = {name: self.normalise[name](self._merged(values)) for name, values in total.items()}
        attributes = {key: functional.relu(self.edge[key](z)) for key, z in graph.attributes.items()}
        return Graph(nodes, graph.edges, attributes)

    def _messages(self, relation: Relation, graph: Graph, target: Tensor) -> Tensor:
        """What the relation's targets are sent, (R, targets, H, W)."""
        key = relation.key
        sent = self._heads(self.message[key](graph.nodes[relation.source])).transpose(1, 2)  # (R, H, sources, W)
        attend = self.attend[key]
        logits = (target * attend[0]).sum(-1).transpose(1, 2)[..., None] + (sent @ attend[1][..., None]).mT
        if key in self.edge_message:
            weight = cast(nn.Linear, self.edge_message[key]).weight.view(self.heads, self.width, -1)
            score = (attend[2][:, None] @ weight).squeeze(1)  # (H, edge values)
            logits = logits + (graph.attributes[key] @ score.T).permute(0, 3, 1, 2)
        alpha = (functional.leaky_relu(logits, NEGATIVE_SLOPE) + graph.edges[key].bias).softmax(-1)
        alpha = alpha * graph.edges[key].any_source  # (R, H, targets, sources), zeros for a target without sources
        messages = (alpha @ sent).transpose(1, 2)
        if key in self.edge_message:
            summed = alpha.transpose(1, 2) @ graph.attributes[key]  # (R, targets, H, edge values)
            messages = messages + (summed.transpose(1, 2) @ weight.mT).transpose(1, 2)
        return messages

    def _heads(self, values: Tensor) -> Tensor:
        return values.unflatten(-1, (self.heads, self.width))

    def _merged(self, values: Tensor) -> Tensor:
        return functional.relu(values).flatten(2) if self.merge else functional.relu(values.mean(2))


class DeepEdgeEncoder(nn.Module):
    """`layers` layers; node features and the pairs' edge embeddings come out.

    Args:
        width, heads, edge_width: sizes of the layers.
        layers: how many.
        outputs: node type -> number of values that come out.
    """

    def __init__(self, *, width: int, heads: int, edge_width: int, layers: int, outputs: Mapping[str, int]) -> None:
        super().__init__()
        sizes = dict(NODES)
        edge_sizes = {relation.key: len(relation.attributes) for relation in RELATIONS if relation.attributes}
        self.layers = nn.ModuleList()
        for k in range(layers):
            layer = DeepEdgeLayer(
                sizes, edge_sizes, width=width, heads=heads, edge_width=edge_width, merge=k < layers - 1
            )
            self.layers.append(layer)
            sizes = dict.fromkeys(NODES, layer.out_size)
            edge_sizes = dict.fromkeys(edge_sizes, edge_width)
        raw = {name: NODES[name] for name in outputs}
        self.out = nn.ModuleDict({name: nn.Linear(width + raw[name], size) for name, size in outputs.items()})

    def forward(self, graph: Graph) -> tuple[dict[str, Tensor], Tensor]:
        """Values (R, n, outputs[type]) of the node types `outputs`, and pairs' embeddings (R, N, A, edge_width).

        A node's own features are read once more beside what the last layer says of it.
        """
        first = graph.nodes
        for layer in self.layers:
            graph = layer(graph)
        nodes = {name: out(torch.cat([graph.nodes[name], first[name]], -1)) for name, out in self.out.items()}
        return nodes, graph.attributes["agent_use_time_task"]

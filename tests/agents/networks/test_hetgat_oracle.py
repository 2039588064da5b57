"""The layer against the same layer composed from PyTorch Geometric's parts, on the same weights."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch_geometric.nn import GATConv, HeteroConv, Linear, SimpleConv
from torch_geometric.utils import scatter

from marl_sched.agents.networks.hetgat.inputs import attends, read_graph
from marl_sched.agents.networks.hetgat.layer import HetGATLayer
from marl_sched.agents.networks.hetgat.network import HetGATEncoder
from marl_sched.graph import DECISION, STATE, GraphSpec, Relation

Nodes = dict[str, Tensor]
EdgeType = tuple[str, str, str]


def filled(weight: Tensor) -> Linear:
    """A PyTorch Geometric linear layer with the given weight (out, in)."""
    linear = Linear(weight.shape[1], weight.shape[0], bias=False).double()
    linear.weight = nn.Parameter(weight)
    return linear


class Plain(nn.Module):
    """Messages without attention: a sum of linear transforms of neighbours and edge attributes."""

    def __init__(self, layer: HetGATLayer, relation: Relation) -> None:
        super().__init__()
        self.linear, self.sum = filled(layer.message[relation.key].flatten(0, 1)), SimpleConv(aggr="sum")
        self.edge = filled(layer.edge[relation.key].flatten(0, 1)) if relation.attributes else None

    def forward(self, x: Tensor | tuple[Tensor, Tensor], edge_index: Tensor, edge_attr: Tensor | None) -> Tensor:
        source, target = x if isinstance(x, tuple) else (x, x)
        out = self.sum((self.linear(source), target), edge_index)
        if self.edge is not None:
            out = out + scatter(self.edge(edge_attr), edge_index[1], dim_size=len(target), reduce="sum")
        return out


class Attention(nn.Module):
    """Messages with attention by GATConv, which knows edge attributes in the coefficients but not in messages."""

    def __init__(self, layer: HetGATLayer, relation: Relation) -> None:
        super().__init__()
        key, heads, width = relation.key, layer.heads, layer.width
        own = (
            layer.own[relation.target].flatten(0, 1) if relation.target in layer.own else torch.zeros(heads * width, 1)
        )
        message = layer.message[key].flatten(0, 1)
        self.conv = GATConv(
            (message.shape[1], own.shape[1]),
            width,
            heads=heads,
            negative_slope=0.2,
            add_self_loops=False,
            bias=False,
            edge_dim=len(relation.attributes) or None,
        ).double()
        self.conv.lin_src.weight, self.conv.lin_dst.weight = nn.Parameter(message), nn.Parameter(own.double())
        self.conv.att_src = nn.Parameter(layer.attend_source[key][None])
        zero = torch.zeros_like(layer.attend_source[key])
        self.conv.att_dst = nn.Parameter((layer.attend_target.get(key, zero))[None])
        self.edge = None
        if relation.attributes:
            self.edge = filled(layer.edge[key].flatten(0, 1))
            self.conv.lin_edge.weight = nn.Parameter(layer.edge[key].flatten(0, 1))
            self.conv.att_edge = nn.Parameter(layer.attend_edge[key][None])

    def forward(self, x: Tensor | tuple[Tensor, Tensor], edge_index: Tensor, edge_attr: Tensor | None) -> Tensor:
        pair = x if isinstance(x, tuple) else (x, x)
        out, (_, alpha) = self.conv(pair, edge_index, edge_attr, return_attention_weights=True)
        if self.edge is not None:
            messages = self.edge(edge_attr).unflatten(1, (*alpha.shape[1:], -1)) * alpha[..., None]
            out = out + scatter(messages.flatten(1), edge_index[1], dim_size=len(pair[1]), reduce="sum")
        return out


def edges_of(relation: Relation, row: dict[str, Tensor], visible: dict[str, list[int]]) -> tuple[Tensor, Tensor | None]:
    """One graph's edges among visible nodes, written down one by one: (2, n_edges) and attributes."""
    pairs, attributes = [], []
    for i in visible[relation.source]:
        for j in visible[relation.target]:
            linked = {
                "all": lambda i, j: True,
                "same": lambda i, j: i == j,
                "scatter": lambda i, j: row[relation.index][i] == j,
                "gather": lambda i, j: row[relation.index][j] == i,
                "dense": lambda i, j: row[relation.name][j, i] == 1,
            }[relation.pattern]
            if linked(i, j):
                pairs.append((i, j))
                if relation.attributes:
                    attributes.append(row[f"{relation.name}_attributes"][j, i].double())
    index = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).T
    if not relation.attributes:
        return index, None
    return index, torch.stack(attributes) if attributes else torch.zeros(0, len(relation.attributes)).double()


def composed(layer: HetGATLayer, nodes: Nodes, edges: dict[str, tuple[Tensor, Tensor | None]]) -> Nodes:
    """One graph's new features, by HeteroConv over the relations and a linear layer for each node itself."""
    convs = {(r.source, r.name, r.target): (Attention if attends(r) else Plain)(layer, r) for r in layer.relations}
    x = {name: values if values.shape[1] else torch.zeros(len(values), 1).double() for name, values in nodes.items()}
    keys = {(r.source, r.name, r.target): r.key for r in layer.relations}
    index = {kind: edges[key][0] for kind, key in keys.items()}
    attributes = {kind: edges[key][1] for kind, key in keys.items()}
    messages = HeteroConv(convs, aggr="sum")(x, index, edge_attr_dict=attributes)
    out = {}
    for name in layer.outputs:
        total = messages.get(name, 0)
        if name in layer.own:
            total = total + filled(layer.own[name].flatten(0, 1))(nodes[name])
        if layer.merge == "mean":
            total = total.unflatten(1, (layer.heads, layer.width)).mean(1)
        out[name] = torch.relu(total + layer.bias[name])
    return out


@pytest.mark.parametrize("layers", [1, 3])
def test_layers_equal_a_composition_of_pytorch_geometric_layers(graph: GraphSpec, sizes, observe, layers: int):
    torch.manual_seed(layers)
    everything = [node.name for node in graph.nodes] + [STATE, DECISION]
    encoder = HetGATEncoder(graph, width=5, heads=3, layers=layers, outputs=everything).double()
    for name, parameter in encoder.named_parameters():
        if "bias" in name:
            nn.init.normal_(parameter)
    observation = observe(graph, sizes, batch=4, seed=layers)
    ours, read = encoder(observation)
    assert {r.key for r in encoder.layers[-1].relations} == {
        r.key for r in graph.relations if layers > 1 or r.source != DECISION
    }
    for b in range(4):
        row = {name: values[b] for name, values in observation.items()}
        visible = {name: mask[b].nonzero().flatten().tolist() for name, mask in read.masks.items()}
        nodes = {node.name: row[node.name].double() for node in graph.nodes} | {STATE: row[STATE][None].double()}
        nodes[DECISION] = torch.zeros(sizes[graph.decision_of], 0).double()
        edges = {r.key: edges_of(r, row, visible) for r in graph.relations}
        for layer in encoder.layers:
            nodes = composed(layer, nodes, edges)
        for name in everything:
            torch.testing.assert_close(ours[name][b][visible[name]], nodes[name][visible[name]], rtol=1e-9, atol=1e-9)


def test_single_precision_stays_within_the_stated_tolerance(graph: GraphSpec, sizes, observe):
    torch.manual_seed(0)
    encoder = HetGATEncoder(graph, width=8, heads=4, layers=3, outputs=[DECISION])
    observation = observe(graph, sizes, batch=8)
    single = encoder(observation)[0][DECISION].double()
    double = encoder.double()(observation)[0][DECISION]
    visible = read_graph(graph, observation, []).masks[DECISION]
    assert (single - double)[visible].abs().max() < 1e-5

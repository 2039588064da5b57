"""An observation's arrays as tensors that the graph layers can read: what is masked is zero and has no edges.

Everything that all layers share is worked out here once: masks, adjacency and flat indices.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from marl_sched.graph import DECISION, STATE, GraphSpec, Relation


@dataclass(frozen=True)
class GraphInputs:
    """A batch of problem graphs.

    Attributes:
        batch: B.
        counts: node type -> number of padded slots n.
        nodes: node type -> float (B, n, f), zero where masked; the state node is (B, 1, f), and decision
            nodes, whose first features are zero, have no entry.
        masks: node type -> bool (B, n), what exists and is visible.
        edges: key of a relation that sums without attention -> float (B, n_t, n_s), 1 where there is an edge,
            or (B, 1, n_s) where all targets have the same sources.
        gaps: key of a relation with attention -> bool, the same shapes, true where there is no edge.
        links: name of an index array -> its `Links`, for scatter relations without attention and for gather ones.
        attributes: key of a dense relation with edge attributes -> float (B, n_t, n_s, e), zero off the edges.
    """

    batch: int
    counts: dict[str, int] = field(default_factory=dict)
    nodes: dict[str, Tensor] = field(default_factory=dict)
    masks: dict[str, Tensor] = field(default_factory=dict)
    edges: dict[str, Tensor] = field(default_factory=dict)
    gaps: dict[str, Tensor] = field(default_factory=dict)
    links: dict[str, Links] = field(default_factory=dict)
    attributes: dict[str, Tensor] = field(default_factory=dict)


class Links(NamedTuple):
    """At most one other end for each of n nodes: the sources of a scatter, the targets of a gather relation.

    Attributes:
        absent: bool (B n, 1), true where there is none, or where either end is hidden.
        rows: int64 (B n,), the other end's row in a tensor (B n_other, features), meaningless where absent.
    """

    absent: Tensor
    rows: Tensor


def attends(relation: Relation) -> bool:
    """Whether a relation has attention coefficients: it asks for them and a target can have several sources.

    With a single source the softmax of equation 6.7 is 1, whatever its weights are.
    """
    several = relation.pattern in ("all", "scatter", "dense") and relation.source != STATE
    return relation.attention and several


def read_graph(
    spec: GraphSpec,
    observation: Mapping[str, Tensor],
    relations: Collection[Relation],
    dtype: torch.dtype = torch.float32,
) -> GraphInputs:
    """The graph in an observation (marl_sched.graph, with batch axis), prepared for `relations`.

    Hidden and padded entries may hold anything, NaN included, and an index may point to a hidden node.
    """
    state = observation[STATE].to(dtype)
    graph = GraphInputs(state.shape[0])
    graph.nodes[STATE] = state[:, None]
    graph.counts[STATE] = 1
    graph.masks[STATE] = torch.ones(state.shape[0], 1, dtype=torch.bool, device=state.device)
    for node in spec.nodes:
        mask = observation[f"{node.name}_mask"] != 0
        graph.masks[node.name] = mask
        graph.counts[node.name] = mask.shape[1]
        graph.nodes[node.name] = observation[node.name].to(dtype).masked_fill(~mask[..., None], 0.0)
    graph.masks[DECISION] = graph.masks[spec.decision_of]
    graph.counts[DECISION] = graph.counts[spec.decision_of]
    for relation in relations:
        _connect(graph, relation, observation, dtype)
    return graph


def _connect(graph: GraphInputs, relation: Relation, observation: Mapping[str, Tensor], dtype: torch.dtype) -> None:
    """Add a relation's edges in the form in which its pattern is computed."""
    key, source_mask = relation.key, graph.masks[relation.source]
    if relation.pattern == "all" and relation.source != STATE:
        _connect_densely(graph, relation, source_mask[:, None], dtype)
    elif relation.pattern == "dense":
        edges = (observation[relation.name] != 0) & source_mask[:, None]
        _connect_densely(graph, relation, edges, dtype)
        if relation.attributes:
            attributes = observation[f"{relation.name}_attributes"].to(dtype)
            graph.attributes[key] = attributes.masked_fill(~edges[..., None], 0.0)
    elif relation.pattern == "scatter" and attends(relation):
        index = observation[str(relation.index)]
        slots = torch.arange(graph.counts[relation.target], device=index.device)
        edges = (index[:, None] == slots[:, None]) & source_mask[:, None]
        _connect_densely(graph, relation, edges, dtype)
    elif relation.pattern == "scatter":
        _link(graph, str(relation.index), observation, relation.source, relation.target)
    elif relation.pattern == "gather":
        _link(graph, str(relation.index), observation, relation.target, relation.source)


def _connect_densely(graph: GraphInputs, relation: Relation, edges: Tensor, dtype: torch.dtype) -> None:
    if attends(relation):
        graph.gaps[relation.key] = ~edges
    else:
        graph.edges[relation.key] = edges.to(dtype)


def _link(graph: GraphInputs, name: str, observation: Mapping[str, Tensor], owner: str, other: str) -> None:
    """Read the index array `name` that runs over `owner` nodes and points to `other` nodes, once for all relations."""
    if name in graph.links:
        return
    index, n_other = observation[name], graph.counts[other]
    present = (index >= 0) & graph.masks[owner]
    first_row = torch.arange(0, graph.batch * n_other, n_other, device=index.device)[:, None]
    rows = torch.where(present, index + first_row, 0).view(-1)
    absent = ~(present.view(-1) & graph.masks[other].view(-1).index_select(0, rows))
    graph.links[name] = Links(absent[:, None], rows)

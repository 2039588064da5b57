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
        edges: relation key -> bool (B, n_t, n_s), or (B, 1, n_s) where all targets have the same sources.
        links: key of a relation given by an index and without attention -> its `Links`.
        attributes: key of a dense relation with edge attributes -> float (B, n_t, n_s, e), zero off the edges.
    """

    batch: int
    counts: dict[str, int] = field(default_factory=dict)
    nodes: dict[str, Tensor] = field(default_factory=dict)
    masks: dict[str, Tensor] = field(default_factory=dict)
    edges: dict[str, Tensor] = field(default_factory=dict)
    links: dict[str, Links] = field(default_factory=dict)
    attributes: dict[str, Tensor] = field(default_factory=dict)


class Links(NamedTuple):
    """At most one other end for each of n nodes: the sources of a scatter, the targets of a gather relation.

    Attributes:
        present: bool (B n, 1), whether there is one.
        rows: int64 (B n,), its row in a tensor (B n_other, features); 0 where there is none.
    """

    present: Tensor
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
        graph.nodes[node.name] = torch.where(mask[..., None], observation[node.name].to(dtype), 0.0)
    graph.masks[DECISION] = graph.masks[spec.decision_of]
    graph.counts[DECISION] = graph.counts[spec.decision_of]
    for relation in relations:
        _connect(graph, relation, observation, dtype)
    return graph


def _connect(graph: GraphInputs, relation: Relation, observation: Mapping[str, Tensor], dtype: torch.dtype) -> None:
    """Add a relation's edges in the form in which its pattern is computed."""
    key, source_mask = relation.key, graph.masks[relation.source]
    if relation.pattern == "all":
        graph.edges[key] = source_mask[:, None]
    elif relation.pattern == "dense":
        edges = (observation[relation.name] != 0) & source_mask[:, None]
        graph.edges[key] = edges
        if relation.attributes:
            attributes = observation[f"{relation.name}_attributes"].to(dtype)
            graph.attributes[key] = torch.where(edges[..., None], attributes, 0.0)
    elif relation.pattern == "scatter":
        index = observation[str(relation.index)]
        present = (index >= 0) & source_mask
        if attends(relation):
            slots = torch.arange(graph.counts[relation.target], device=index.device)
            graph.edges[key] = (index[:, None] == slots[:, None]) & present[:, None]
        else:
            graph.links[key] = _links(index, present, graph.counts[relation.target])
    elif relation.pattern == "gather":
        index = observation[str(relation.index)]
        present = (index >= 0) & graph.masks[relation.target]
        present = present & source_mask.gather(1, torch.where(present, index, 0))
        graph.links[key] = _links(index, present, graph.counts[relation.source])


def _links(index: Tensor, present: Tensor, n_other: int) -> Links:
    first_row = torch.arange(index.shape[0], device=index.device)[:, None] * n_other
    return Links(present.view(-1, 1), torch.where(present, index + first_row, 0).flatten())

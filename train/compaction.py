"""Smaller graphs for learning: where agents see a part of the problem, most padded slots are empty.

A policy does not care in which slots nodes stand (permuting them permutes its decisions), so visible nodes
can move to the front and the rest be cut off. For AirME's `local(reach=1)` that halves the cost of an update.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from marl_sched.graph import ACTION_MASK, GraphSpec


def compacted(spec: GraphSpec, observation: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    """Observations (N, ...) with visible nodes in front, in their old order, and the targets' old names.

    Every node type gets as many slots as the observation that sees most of it needs. Hidden nodes vanish;
    an index to one becomes -1. The second value, int64 (N, n_kept), holds the target that each decision
    node was before; target 0, which is always visible, stays 0.
    """
    out = dict(observation)
    order: dict[str, Tensor] = {}  # new slot -> old slot, (N, kept)
    place: dict[str, Tensor] = {}  # old slot -> new slot or -1, (N, n)
    for node in spec.nodes:
        mask = observation[f"{node.name}_mask"]
        kept = max(int((mask != 0).sum(1).max()), 1)
        order[node.name] = torch.argsort((mask == 0).byte(), dim=1, stable=True)[:, :kept]
        slots = torch.arange(kept).expand(len(mask), kept)
        place[node.name] = torch.full(mask.shape, -1, dtype=torch.int64).scatter_(1, order[node.name], slots)
        place[node.name][mask == 0] = -1
        out[node.name] = _along(1, observation[node.name], order[node.name])
        out[f"{node.name}_mask"] = mask.gather(1, order[node.name])
    for name, owner, other in _indices(spec):
        index = observation[name].gather(1, order[owner])
        moved = place[other].gather(1, index.clamp(min=0))
        out[name] = torch.where(index >= 0, moved, -1)
    for relation in spec.relations:
        if relation.pattern == "dense":
            for name in (relation.name, f"{relation.name}_attributes") if relation.attributes else (relation.name,):
                rows = _along(1, observation[name], order[relation.target])
                out[name] = _along(2, rows, order[relation.source])
    out[ACTION_MASK] = observation[ACTION_MASK].gather(1, order[spec.decision_of])
    return out, order[spec.decision_of]


def _indices(spec: GraphSpec) -> set[tuple[str, str, str]]:
    """(array, node type that it runs over, node type that it points to)."""
    scatter = {(str(r.index), r.source, r.target) for r in spec.relations if r.pattern == "scatter"}
    gather = {(str(r.index), r.target, r.source) for r in spec.relations if r.pattern == "gather"}
    return scatter | gather


def _along(axis: int, values: Tensor, order: Tensor) -> Tensor:
    """`values` (N, ..., n, ...) with the slots of `axis` in `order` (N, kept)."""
    shape = [1] * values.dim()
    shape[0], shape[axis] = order.shape
    index = order.view(shape).expand([*values.shape[:axis], order.shape[1], *values.shape[axis + 1 :]])
    return values.gather(axis, index)

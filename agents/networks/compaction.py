"""Smaller graphs: where agents see a part of the problem, most padded slots are empty.

A permutation-equivariant network does not depend on the slots in which nodes stand (permuting them permutes its
decisions), so visible nodes can move to the front and the rest be cut off. With AirME's `local(reach=1)` that halves
the cost of an update on small fleets, and leaves a fifth of the cost of a decision on large ones.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from marl_sched.graph import ACTION_MASK, DECISION, GraphSpec


def slots_needed(spec: GraphSpec, observation: Mapping[str, Tensor]) -> dict[str, int]:
    """Node type -> how many slots the observation that sees most of it needs, at least 1.

    Types whose slots correspond (`same`), other than decisions to what they are on, keep all of theirs.
    """
    tied = {end for r in spec.relations if r.pattern == "same" for end in (r.source, r.target) if r.target != DECISION}
    masks = {node.name: observation[f"{node.name}_mask"] for node in spec.nodes}
    return {
        name: mask.shape[1] if name in tied else max(int(mask.count_nonzero(1).max()), 1)
        for name, mask in masks.items()
    }


def compacted(
    spec: GraphSpec, observation: Mapping[str, Tensor], slots: Mapping[str, int] | None = None
) -> tuple[dict[str, Tensor], Tensor]:
    """Observations (N, ...) with visible nodes in front, in their old order, and the actions' old names.

    Every node type gets `slots`, by default those of `slots_needed`. Hidden nodes vanish; an index to one becomes
    -1. The second value, int64 (N, n_kept), holds the action that each decision node was before; action 0,
    which is always visible, stays 0.
    """
    out = dict(observation)
    order: dict[str, Tensor] = {}  # new slot -> old slot, (N, kept)
    place: dict[str, Tensor] = {}  # old slot -> new slot or -1, (N, n)
    for name, kept in (slots_needed(spec, observation) if slots is None else slots).items():
        visible = observation[f"{name}_mask"] != 0
        old = torch.arange(visible.shape[1], device=visible.device).expand(visible.shape)
        new = old
        if kept < visible.shape[1]:
            seen = visible.cumsum(1)
            new = torch.where(visible, seen - 1, seen[:, -1:] + old - seen)
        order[name] = torch.empty_like(new).scatter_(1, new, old)[:, :kept]
        place[name] = torch.where(visible, new, -1)
        for array in (name, f"{name}_mask"):
            out[array] = _along(1, observation[array], order[name])
    order[DECISION] = order[spec.decision_of]
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

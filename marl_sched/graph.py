"""The problem graph as typed, padded arrays: what a domain declares and what a policy reads.

A `GraphSpec` names the node types with their features and the relations between them (dissertation,
figures 4.3, 5.2 and 6.2). Two node types need no declaration: the one `state` node, which summarises what
is visible, and the `decision` nodes, one for each node of the type that is chosen from, whose first
features are zero (section 6.3.2).

An observation is a dict of arrays, with a leading batch axis B inside simulators and policies and without
it in PettingZoo and Gymnasium. For a node type `plane` with n padded slots and f features:

    plane         (B, n, f)  float32   features, zero where hidden or padded
    plane_mask    (B, n)     int8      1 where the node exists and is visible
    state         (B, f)     float32   summary of the visible nodes
    <index>       (B, n_s)   int64     for relations of pattern scatter and gather: node of the other side, -1 for none
    <name>        (B, n_t, n_s)     int8     for relations of pattern dense: 1 where there is an edge
    <name>_attributes (B, n_t, n_s, e) float32
    action_mask   (B, n)     int8      1 where the acting agent may choose the decision node; slot 0 is always 1
    time          (B,)       float32   simulated time; no node carries it, a policy reads it only if told to
    visible_share (B,)       float32   share of the nodes chosen from that the agent sees, slot 0 not counted
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from marl_sched.errors import require

Pattern = Literal["all", "same", "scatter", "gather", "dense"]
STATE, DECISION = "state", "decision"
ACTION_MASK, TIME, VISIBLE_SHARE = "action_mask", "time", "visible_share"
AVAILABLE = "available"  # the feature of nodes that can be away for a while; see TurnSimulator.availability


@dataclass(frozen=True)
class Feature:
    """A quantity of a node, and the scale by which an observation divides it.

    `whole`: the quantity is an integer, and is read back as one whatever the rounding of float32.
    """

    name: str
    scale: float = 1.0
    whole: bool = False

    @property
    def label(self) -> str:
        """`hours/10`: how a metagraph, and so a policy's card, names the feature."""
        return self.name if self.scale == 1 else f"{self.name}/{self.scale:g}"


class Features:
    """The features of a node type in the order of the last axis; writes and reads them in their own units.

    PLANE = Features(Feature("hours", 10, whole=True), Feature("broken"))
    PLANE.read(observation["plane"], "hours")        # float64 (B, n), in hours
    """

    def __init__(self, *features: Feature) -> None:
        self._features = features
        self._index = {feature.name: k for k, feature in enumerate(features)}
        if len(self._index) != len(features):
            raise ValueError(f"features: expected names that differ, got {[feature.name for feature in features]}")

    def __len__(self) -> int:
        """How many there are."""
        return len(self._features)

    def __add__(self, more: Features) -> Features:
        """These features, then `more`."""
        return Features(*self._features, *more._features)

    @property
    def labels(self) -> tuple[str, ...]:
        """What a NodeType names them."""
        return tuple(feature.label for feature in self._features)

    def index(self, name: str) -> int:
        """The place of a feature in the last axis; UnknownNameError for a name that none has."""
        return self._index[require("feature", name, self._index)]

    def scale(self, name: str) -> float:
        """What an observation divides the feature by."""
        return self._features[self.index(name)].scale

    def factor(self, name: str) -> np.float32:
        """What a kernel multiplies the quantity by to write the feature: 1 / scale in float32."""
        return np.float32(1.0 / self.scale(name))

    def read(self, array: np.ndarray, name: str) -> np.ndarray:
        """A quantity in its own unit, float64 (...), from an observation's float32 (..., f)."""
        index = self.index(name)
        feature = self._features[index]
        value = np.asarray(array[..., index], np.float64) * feature.scale
        return np.rint(value) if feature.whole else value

    def write(self, array: np.ndarray, where: Any, **values: Any) -> None:
        """Write quantities, given in their own units, into float32 (..., f) at the nodes `where`."""
        for name, value in values.items():
            index = self.index(name)
            array[where, index] = np.asarray(value, np.float64) / self._features[index].scale


@dataclass(frozen=True)
class NodeType:
    """A class of nodes and the names of its features, in the order of the last axis."""

    name: str
    features: tuple[str, ...]


@dataclass(frozen=True)
class Relation:
    """Messages from `source` nodes to `target` nodes; (source, name, target) is the edge type.

    Patterns:
        all      every visible source to every target (planes to the state node, the state node to decisions)
        same     source i to target i (planes to their decision nodes)
        scatter  source i to target index[i], where `index` names an array over the sources
        gather   target i from source index[i], where `index` names an array over the targets
        dense    an adjacency array named `name`, with edge attributes if any are named
    """

    source: str
    name: str
    target: str
    pattern: Pattern
    attention: bool = False
    index: str | None = None
    attributes: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """`source_name_target`, unique within a graph."""
        return f"{self.source}_{self.name}_{self.target}"


@dataclass(frozen=True)
class ArraySpec:
    """Shape without batch axis, dtype and bounds of one array of an observation."""

    shape: tuple[int, ...]
    dtype: np.dtype
    low: float
    high: float

    def empty(self, batch: int) -> np.ndarray:
        """A zeroed array with a leading batch axis."""
        return np.zeros((batch, *self.shape), self.dtype)


@dataclass(frozen=True)
class GraphSpec:
    """A domain's metagraph: node types, the state node's features, relations, and what is decided on."""

    nodes: tuple[NodeType, ...]
    state_features: tuple[str, ...]
    relations: tuple[Relation, ...]
    decision_of: str

    def node(self, name: str) -> NodeType:
        """The declared node type of that name."""
        return next(node for node in self.nodes if node.name == name)

    def arrays(self, sizes: dict[str, int]) -> dict[str, ArraySpec]:
        """All arrays of an observation for `sizes` padded slots per node type, in a fixed order."""
        features, mask, index = np.dtype(np.float32), np.dtype(np.int8), np.dtype(np.int64)
        inf = float("inf")
        out: dict[str, ArraySpec] = {}
        for node in self.nodes:
            n = sizes[node.name]
            out[node.name] = ArraySpec((n, len(node.features)), features, -inf, inf)
            out[f"{node.name}_mask"] = ArraySpec((n,), mask, 0, 1)
        out[STATE] = ArraySpec((len(self.state_features),), features, -inf, inf)
        for relation in self.relations:
            n_source, n_target = sizes.get(relation.source, 1), sizes.get(relation.target, 1)
            if relation.pattern == "scatter":
                out.setdefault(str(relation.index), ArraySpec((n_source,), index, -1, n_target - 1))
            elif relation.pattern == "gather":
                out.setdefault(str(relation.index), ArraySpec((n_target,), index, -1, n_source - 1))
            elif relation.pattern == "dense":
                out[relation.name] = ArraySpec((n_target, n_source), mask, 0, 1)
                if relation.attributes:
                    shape = (n_target, n_source, len(relation.attributes))
                    out[f"{relation.name}_attributes"] = ArraySpec(shape, features, -inf, inf)
        out[ACTION_MASK] = ArraySpec((sizes[self.decision_of],), mask, 0, 1)
        out[TIME] = ArraySpec((), features, 0, inf)
        out[VISIBLE_SHARE] = ArraySpec((), features, 0, 1)
        return out

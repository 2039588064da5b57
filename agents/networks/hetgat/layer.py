"""One heterogeneous graph attention layer, built from a domain's `GraphSpec` alone.

For a node i of type T (dissertation, equations 4.3-4.14 and 6.3-6.7):

    h'_i = ReLU( W_T h_i + b_T  +  sum over relations r into T of  sum_j alpha_ij (W_r h_j + W_edge,r e_ij) )

with alpha_ij = 1 for relations without attention, and otherwise the softmax over the visible sources j of

    LeakyReLU( a_r . [ W_T h_i || W_r h_j || W_edge,r e_ij ] )

Several heads compute this in parallel; they are concatenated, or averaged before the ReLU. Every node type
has its own transform W_T (the self-loop), which also serves as the target's side of the attention, as in
equation 6.7. An empty neighbourhood gives a zero message.

What is computed is the same formula in a cheaper order. The attention logits of all relations that touch a
node type are one matrix product with its features, since a . (W h) = (a W) h.
Where targets are no more than sources (the state node, one plane per crew) features are brought together
first and transformed at the target. Heads that are averaged with equal coefficients are averaged as weights.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from marl_sched.agents.networks.hetgat.inputs import GraphInputs, attends
from marl_sched.graph import DECISION, STATE, GraphSpec, Relation

Merge = Literal["concat", "mean"]
_NEGATIVE_SLOPE = 0.2


@dataclass(frozen=True)
class Projection:
    """One matrix product: `weight` (columns, in) and `bias` (columns,) on a node type, split into `names`."""

    node: str
    names: tuple[str, ...]
    widths: tuple[int, ...]
    weight: Tensor
    bias: Tensor | None


@dataclass(frozen=True)
class LayerWeights:
    """A layer's weights in the form in which they are applied; gradients flow through to the parameters.

    Attributes:
        projections: the matrix products with node features.
        at_target: relation key -> (out, features) or, with attention, (out, heads * features).
        edge: relation key -> the same for edge attributes.
        edge_score: relation key -> (heads, attributes).
    """

    projections: tuple[Projection, ...]
    at_target: dict[str, Tensor]
    edge: dict[str, Tensor]
    edge_score: dict[str, Tensor]


class HetGATLayer(nn.Module):
    """A layer that computes new features of the node types `outputs`.

    Args:
        spec: the metagraph.
        sizes: node type -> number of input features; 0 for nodes that have none yet (decisions at first).
        width: features per head.
        heads: number of heads.
        merge: `concat` gives `heads * width` output features, `mean` gives `width`.
        outputs: the node types that are needed; relations into others have no parameters.
    """

    def __init__(
        self,
        spec: GraphSpec,
        sizes: Mapping[str, int],
        *,
        width: int,
        heads: int,
        merge: Merge,
        outputs: Collection[str],
    ) -> None:
        super().__init__()
        self.width, self.heads, self.merge = width, heads, merge
        self.sizes = dict(sizes)
        self.outputs = tuple(name for name in sizes if name in outputs)
        self.out_size = heads * width if merge == "concat" else width
        self.relations = tuple(r for r in spec.relations if r.target in outputs and sizes[r.source] > 0)
        incoming = {name: [r for r in self.relations if r.target == name] for name in self.outputs}
        self._to_rows = {name: [r for r in found if _to_rows(r)] for name, found in incoming.items()}
        self._to_grid = {name: [r for r in found if not _to_rows(r)] for name, found in incoming.items()}
        self._twins = {spec.decision_of, DECISION}
        self.own, self.bias, self.message, self.edge = (nn.ParameterDict() for _ in range(4))
        self.attend_source, self.attend_target, self.attend_edge = (nn.ParameterDict() for _ in range(3))
        for name in self.outputs:
            if sizes[name] > 0:
                self.own[name] = self._transform(sizes[name])
            self.bias[name] = nn.Parameter(torch.zeros(self.out_size))
        for relation in self.relations:
            self._add_relation(relation)

    def _add_relation(self, relation: Relation) -> None:
        key, n_attributes = relation.key, len(relation.attributes)
        self.message[key] = self._transform(self.sizes[relation.source])
        if n_attributes:
            self.edge[key] = self._transform(n_attributes)
        if attends(relation):
            self.attend_source[key] = self._attention(relation)
            if relation.target in self.own:
                self.attend_target[key] = self._attention(relation)
            if n_attributes:
                self.attend_edge[key] = self._attention(relation)

    def _transform(self, n_in: int) -> nn.Parameter:
        """A weight (heads, width, in), drawn as Glorot and Bengio do for one head."""
        bound = (6 / (n_in + self.width)) ** 0.5
        return nn.Parameter(torch.empty(self.heads, self.width, n_in).uniform_(-bound, bound))

    def _attention(self, relation: Relation) -> nn.Parameter:
        """One of the parts, (heads, width), of the attention vector a."""
        parts = 3 if relation.attributes else 2
        bound = (6 / (parts * self.width + 1)) ** 0.5
        return nn.Parameter(torch.empty(self.heads, self.width).uniform_(-bound, bound))

    def weights(self) -> LayerWeights:
        """The weights as they are applied; compute them once for many forward passes with fixed parameters."""
        relations = {relation.key: relation for relation in self.relations}
        return LayerWeights(
            projections=tuple(piece for node, size in self.sizes.items() if size > 0 for piece in self._pieces(node)),
            at_target={k: self._applied(self.message[k], r) for k, r in relations.items() if at_target(r)},
            edge={k: self._applied(weight, relations[k]) for k, weight in self.edge.items()},
            edge_score={k: _score(a, self.edge[k]) for k, a in self.attend_edge.items()},
        )

    def _pieces(self, node: str) -> list[Projection]:
        """Everything that is computed from the features of `node`: its own transform, messages and logits."""
        pieces, scores = [], {}
        if node in self.own:
            own = self._columns(self.own[node], attended=False)
            pieces.append(Projection(node, (node,), (self.out_size,), own, self.bias[node]))
        for relation in self.relations:
            key = relation.key
            if relation.source == node and not at_target(relation):
                weight = self._columns(self.message[key], attends(relation))
                pieces.append(Projection(node, (key,), (weight.shape[0],), weight, None))
            if relation.source == node and key in self.attend_source:
                scores[f"{key}.source"] = _score(self.attend_source[key], self.message[key])
            if relation.target == node and key in self.attend_target:
                scores[f"{key}.target"] = _score(self.attend_target[key], self.own[node])
        if scores:
            widths = (self.heads,) * len(scores)
            pieces.append(Projection(node, tuple(scores), widths, torch.cat(list(scores.values())), None))
        return pieces

    def _columns(self, weight: Tensor, attended: bool) -> Tensor:
        """A transform (heads, width, in) as a matrix (out, in), or (heads * width, in) where heads stay apart."""
        return weight.flatten(0, 1) if attended or self.merge == "concat" else weight.mean(0)

    def _applied(self, weight: Tensor, relation: Relation) -> Tensor:
        """A transform (heads, width, in) as a matrix for features that were summed before it.

        With attention each head has sums of its own: (out, heads * in), the mean over heads included.
        """
        if not attends(relation):
            return self._columns(weight, attended=False)
        if self.merge == "concat":
            return torch.block_diag(*weight)
        return weight.transpose(0, 1).flatten(1) / self.heads

    def forward(
        self, graph: GraphInputs, nodes: Mapping[str, Tensor], weights: LayerWeights | None = None
    ) -> dict[str, Tensor]:
        """New features (B, n, out_size) of the node types `outputs` from `nodes`, (B, n, sizes[type]) each.

        `weights` are those of the method `weights`, computed here if not given. Features of masked nodes
        are meaningless but finite, and reach no other node.
        """
        weights = weights or self.weights()
        flat = {name: features.flatten(0, 1) for name, features in nodes.items()}
        sent: dict[str, Tensor] = {}
        for projection in weights.projections:
            sent.update(_project(projection, flat[projection.node]))
        step = _Step(graph, nodes, flat, sent, weights)
        out: dict[str, Tensor] = {}
        for name in self.outputs:
            shape = (graph.batch, graph.counts[name], self.out_size)
            total = sent[name] if name in sent else self.bias[name].repeat(shape[0] * shape[1], 1)
            for relation in self._to_rows[name]:
                self._add_to_rows(relation, total, step)
            for relation in self._to_grid[name]:
                total = total.view(shape).add_(self._messages(relation, step))
            out[name] = total.relu_().view(shape)
        return out

    def _add_to_rows(self, relation: Relation, total: Tensor, step: _Step) -> None:
        """Add the messages of one relation to `total` (B n_t, out), in place: fresh memory is what costs."""
        key, graph = relation.key, step.graph
        if relation.pattern == "scatter":
            links = graph.links[str(relation.index)]
            total.index_add_(0, links.rows, step.sent[key].masked_fill(links.absent, 0.0))
            return
        if relation.pattern == "gather":
            links = graph.links[str(relation.index)]
            features = step.flat[relation.source].index_select(0, links.rows).masked_fill_(links.absent, 0.0)
        elif relation.pattern == "same":
            features = step.flat[relation.source]
            if not {relation.source, relation.target} <= self._twins:
                features = features.masked_fill(~graph.masks[relation.source].view(-1, 1), 0.0)
        elif attends(relation):
            alpha = self._coefficients(relation, step).squeeze(2)
            features = (alpha @ step.nodes[relation.source]).flatten(1)
        else:
            features = (graph.edges[key] @ step.nodes[relation.source]).flatten(0, 1)
        total.addmm_(features, step.weights.at_target[key].T)

    def _messages(self, relation: Relation, step: _Step) -> Tensor:
        """The messages of one relation, (B, n_t, out), or (B, 1, out) where all targets get the same."""
        key, graph, edge = relation.key, step.graph, step.weights.edge
        sent = step.sent[key].view(graph.batch, graph.counts[relation.source], -1)
        if relation.source == STATE and relation.pattern == "all":
            return sent
        if not attends(relation):
            messages = graph.edges[key] @ sent
            return messages + functional.linear(graph.attributes[key].sum(2), edge[key]) if key in edge else messages
        alpha = self._coefficients(relation, step)
        per_head = alpha @ sent.view(*sent.shape[:2], self.heads, self.width).transpose(1, 2)
        messages = per_head.mean(1) if self.merge == "mean" else per_head.transpose(1, 2).flatten(2)
        if key in edge:
            summed = alpha.transpose(1, 2) @ graph.attributes[key]
            messages = messages + functional.linear(summed.flatten(2), edge[key])
        return messages

    def _coefficients(self, relation: Relation, step: _Step) -> Tensor:
        """Attention coefficients (B, heads, n_t, n_s), zero off the edges (equations 4.8-4.14 and 6.7)."""
        key, graph = relation.key, step.graph
        logits = step.sent[f"{key}.source"].view(graph.batch, -1, self.heads).transpose(1, 2)[:, :, None]
        if key in self.attend_target:
            target = step.sent[f"{key}.target"].view(graph.batch, -1, self.heads)
            logits = logits + target.transpose(1, 2)[..., None]
        if key in self.attend_edge:
            edge_logits = functional.linear(graph.attributes[key], step.weights.edge_score[key])
            logits = logits + edge_logits.permute(0, 3, 1, 2)
        gaps = graph.gaps[key][:, None]
        # The lowest finite number, not -inf: a target without sources must give zeros and not NaN.
        logits = functional.leaky_relu(logits, _NEGATIVE_SLOPE).masked_fill(gaps, torch.finfo(logits.dtype).min)
        return logits.softmax(-1).masked_fill(gaps, 0.0)


class _Step(NamedTuple):
    """What the relations of one forward pass read: features by graph and as rows, and their products."""

    graph: GraphInputs
    nodes: Mapping[str, Tensor]  # type -> (B, n, f)
    flat: dict[str, Tensor]  # type -> (B n, f)
    sent: dict[str, Tensor]  # name -> (B n, width)
    weights: LayerWeights


def at_target(relation: Relation) -> bool:
    """Whether a relation brings features to its targets first and transforms them there.

    That is cheaper where targets are no more than sources.
    """
    if relation.pattern == "all":
        return relation.target == STATE and relation.source != STATE
    return relation.pattern in ("same", "gather")


def _to_rows(relation: Relation) -> bool:
    """Whether messages can be added to the targets of all graphs at once, as rows of one matrix."""
    return at_target(relation) or (relation.pattern == "scatter" and not attends(relation))


def _project(projection: Projection, features: Tensor) -> Iterator[tuple[str, Tensor]]:
    """A projection of features (B n, in) and the names of its pieces, each of which may be changed in place."""
    product = functional.linear(features, projection.weight, projection.bias)
    if len(projection.names) == 1:
        yield projection.names[0], product
        return
    start = 0
    for name, width in zip(projection.names, projection.widths, strict=True):
        yield name, product.narrow(-1, start, width)
        start += width


def _score(vector: Tensor, weight: Tensor) -> Tensor:
    """The attention half a W, (heads, in), of a vector (heads, width) and a transform (heads, width, in)."""
    return (vector[:, None] @ weight).squeeze(1)

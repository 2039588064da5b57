"""Decima (Mao et al. 2019) as the dissertation adapts it (section 6.5.1): one sum over the tasks, one score for each.

    h_s  = g( sum over m in N(s) of f(h_m) )        equation 6.9
    q_m  = q( f(h_m), h_s )
    p(m) = softmax over m in M of q_m               equation 6.10

The tasks are the nodes that decisions are on (AirME's planes). What the text leaves open is settled so: N(s) are all
visible tasks, those in somebody's hands and the null task included; M are those that the action mask allows, of which
the null task always is one. The state node's own features do not enter, as equation 6.9 has no place for them, and
neither do agents (crews), which the bipartite graph does not contain.
"""

from __future__ import annotations

from collections.abc import Mapping

from msgspec import Struct
from torch import Tensor

from marl_sched.agents.networks.network import (
    PolicyNetwork,
    explore_at_first,
    fully_connected,
    mask_logits,
    scores_beside,
    visible_features,
)
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Layers, Width
from marl_sched.graph import GraphSpec


class DecimaConfig(
    NetworkConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="decima"
):
    """Sizes of Decima's networks f, g and q: features of a layer, layers of each."""

    hidden: Width
    layers: Layers

    def build(self, graph: GraphSpec) -> DecimaNetwork:
        """See NetworkConfig."""
        return DecimaNetwork(graph, hidden=self.hidden, layers=self.layers)


class DecimaNetwork(PolicyNetwork):
    """f, g and q as separate networks; no weight depends on the number of tasks.

    Args:
        spec: the metagraph.
        hidden: width of every layer, and of the embeddings f(h_m) and h_s.
        layers: fully connected layers of each of the three networks, ReLU between them.
    """

    permutation_equivariant = True

    def __init__(self, spec: GraphSpec, *, hidden: int = 64, layers: int = 3) -> None:
        super().__init__()
        self.spec = spec
        self.config = DecimaConfig(hidden=hidden, layers=layers)
        self.f = fully_connected(len(spec.node(spec.decision_of).features), hidden, hidden, layers)
        self.g = fully_connected(hidden, hidden, hidden, layers)
        self.q = fully_connected(2 * hidden, hidden, 1, layers)
        explore_at_first(self.q)

    def forward(self, observation: Mapping[str, Tensor], weights: None = None) -> Tensor:
        """Logits (B, n_actions), see PolicyNetwork."""
        task = self.spec.decision_of
        features = visible_features(observation, task, next(self.parameters()).dtype)
        embedded = self.f(features)
        hidden = observation[f"{task}_mask"] == 0
        state = self.g(embedded.masked_fill(hidden[..., None], 0.0).sum(1, keepdim=True))
        return mask_logits(scores_beside(self.q, embedded, state), observation)

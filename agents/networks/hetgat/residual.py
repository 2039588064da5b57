"""A HetGAT policy that starts as a rule and learns where to depart from it.

    logit_i = -beta x log(1 + rank_i) + f( h_i || x_i )

rank_i is the rule's ranking of decision i, a feature of the observation with 0 for the rule's own choice; h_i is the
encoder's output for it, x_i its features as they stand. The logarithm keeps what the rule ranks far behind in reach.
The last layer of f is zero at first, so that an untrained network decides by the rule and explores around it.
Residual policies: Silver et al. 2018, arXiv 1812.06298.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from msgspec import Struct
from torch import Tensor, nn

from marl_sched.agents.networks.hetgat.network import EncoderWeights, HetGATEncoder
from marl_sched.agents.networks.network import PolicyNetwork, mask_logits, visible_features
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Heads, Layers, Width
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import DECISION, STATE, GraphSpec

RANK = "rank/10"
_RANKS = 10.0
_FIRST_BETA = 3.0


class ResidualHetGATConfig(
    NetworkConfig, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field=NAME, tag="hetgat_residual"
):
    """Sizes of a HetGAT network that corrects a rule: features per head, heads, layers, width of the correction."""

    width: Width
    heads: Heads
    layers: Layers
    hidden: Width

    def build(self, graph: GraphSpec) -> ResidualHetGATNetwork:
        """See NetworkConfig."""
        return ResidualHetGATNetwork(graph, width=self.width, heads=self.heads, layers=self.layers, hidden=self.hidden)


class ResidualHetGATNetwork(PolicyNetwork):
    """Logits by rank, corrected by a HetGAT.

    Args:
        spec: the metagraph; the nodes that are chosen from need a feature `rank/10`.
        width, heads, layers: sizes of the encoder.
        hidden: width of the two hidden layers of f.

    Raises InvalidOptionError for a metagraph without ranks.
    """

    permutation_equivariant = True

    def __init__(self, spec: GraphSpec, *, width: int = 16, heads: int = 4, layers: int = 2, hidden: int = 64) -> None:
        super().__init__()
        features = spec.node(spec.decision_of).features
        if RANK not in features:
            raise InvalidOptionError(
                f"policy hetgat_residual: expected a feature {RANK!r} of {spec.decision_of}, got {', '.join(features)}"
            )
        self.spec, self._rank = spec, features.index(RANK)
        self.config = ResidualHetGATConfig(width=width, heads=heads, layers=layers, hidden=hidden)
        self.encoder = HetGATEncoder(spec, width=width, heads=heads, layers=layers, outputs=[DECISION])
        self.normalise = nn.LayerNorm(width)
        self.own = nn.Linear(len(features), hidden)
        self.context = nn.Linear(width, hidden)
        self.correct = nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 1))
        self.log_beta = nn.Parameter(torch.tensor(math.log(_FIRST_BETA)))
        last = self.correct[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def weights(self) -> EncoderWeights:
        """All encoder layers' weights as they are applied, for passes with fixed parameters."""
        return self.encoder.weights()

    def forward(self, observation: Mapping[str, Tensor], weights: EncoderWeights | None = None) -> Tensor:
        """Logits (B, n_actions), see PolicyNetwork."""
        squashed = self._squashed(observation)
        nodes, _ = self.encoder(squashed, weights)
        decisions = nodes[DECISION]
        context = self.context(self.normalise(decisions))
        features = visible_features(squashed, self.spec.decision_of, decisions.dtype)
        correction = self.correct(self.own(features) + context).squeeze(-1)
        rank = observation[self.spec.decision_of][..., self._rank].to(correction.dtype) * _RANKS
        return mask_logits(correction - self.log_beta.exp() * torch.log1p(rank), observation)

    def _squashed(self, observation: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Features as sign(x) log(1 + |x|): long rounds have long times."""
        names = [node.name for node in self.spec.nodes] + [STATE]
        names += [f"{r.name}_attributes" for r in self.spec.relations if r.attributes]
        return {
            name: torch.sign(values) * torch.log1p(values.abs()) if name in names else values
            for name, values in observation.items()
        }

"""ScheduleNet (dissertation, chapter 4): HetGAT layers on the graph of a schedule, one value node for each candidate.

Layers are those of marl_sched.agents.networks.hetgat (equations 4.3 to 4.14), whose target side of the attention is
every type's own transform. Not as published: far fewer parameters, the features of marl_sched.agents.murse.step_graph,
a small head that reads a value node beside its task's features, where the published worth is the value node's output,
and a rule that it corrects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
from msgspec import Meta, Struct
from torch import Tensor

from marl_sched.agents.murse.networks.stepwise import MurseStepNetwork, StepGraphConfig
from marl_sched.agents.murse.step_graph import TASK
from marl_sched.agents.networks.hetgat.network import EncoderWeights, HetGATEncoder
from marl_sched.agents.networks.network import explore_at_first, fully_connected
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Heads, Layers, Width
from marl_sched.graph import DECISION, GraphSpec


class ScheduleNetConfig(
    StepGraphConfig,
    NetworkConfig,
    Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field=NAME,
    tag="schedulenet",
):
    """Sizes: features per head, heads per layer, layers, and the width of the head's hidden layer."""

    width: Width
    heads: Heads
    layers: Layers
    hidden: Annotated[int, Meta(ge=1, le=4096)]

    def build(self, graph: GraphSpec) -> ScheduleNet:
        """See NetworkConfig."""
        return ScheduleNet(graph, self)


class ScheduleNet(MurseStepNetwork):
    """Worths of the tasks that an agent can start, from the heterogeneous graph.

    Args:
        spec: the metagraph.
        config: sizes; published are 64 features, 8 heads, 4 layers.
    """

    usual_candidates = 10.0  # in problems of 40 tasks and fewer there are seldom more

    def __init__(self, spec: GraphSpec, config: ScheduleNetConfig) -> None:
        super().__init__(spec)
        self.config = config
        self.encoder = HetGATEncoder(
            spec, width=config.width, heads=config.heads, layers=config.layers, outputs=[DECISION]
        )
        self.head = fully_connected(config.width + len(TASK), config.hidden, 1, 2)
        explore_at_first(self.head)

    def weights(self) -> EncoderWeights:
        """The layers' weights as they are applied, for passes with fixed parameters."""
        return self.encoder.weights()

    def forward(self, observation: Mapping[str, Tensor], weights: EncoderWeights | None = None) -> Tensor:
        """Worths (K, N + 2), the lowest finite number outside the action mask."""
        nodes, graph = self.encoder(observation, weights)
        values = torch.cat([nodes[DECISION], graph.nodes["task"]], dim=-1)
        return self.corrected(self.head(values).squeeze(-1), observation)

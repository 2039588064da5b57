"""RoboGNN (dissertation, chapter 3): edge-aware graph attention on the minimum distance graph, once for every robot.

Every robot reads the same graph with node features of its own, which say whose a task is. In a layer, for a node i

    h'_i = ReLU( sum over j of alpha_ij (W h_j + W_e e_ji) )                                    (3.10)
    alpha_ij = softmax over j of LeakyReLU( a . [ W h_i || W h_j || W_e e_ji ] )                (3.11)

A robot's embedding is the mean over nodes, the state's the mean over robots; the worth of a task for a robot comes from
the state's embedding and the task's node under the robot's features (Q network of two layers). No weight depends on how
many robots or tasks there are. HomGNN of chapter 4 is the same network, one for each size of team.

Not as published: fewer parameters, the features of marl_sched.agents.murse.step_graph instead of duration and a one-hot
location (edges say what is near), a transform of a node's own features beside its messages, the task's features once
more in the Q network, and a rule that it corrects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
from msgspec import Meta, Struct
from torch import Tensor, nn
from torch.nn import functional

from marl_sched.agents.murse.networks.stepwise import MurseStepNetwork, StepGraphConfig
from marl_sched.agents.murse.step_graph import TASK, TEMPORAL
from marl_sched.agents.networks.network import explore_at_first, fully_connected
from marl_sched.agents.networks.registry import NAME, NetworkConfig
from marl_sched.agents.policies.cards import Heads, Layers, Width
from marl_sched.graph import GraphSpec

_OWNERS = 3  # scheduled to this robot, to another one, not scheduled; s0 and f0 are both of the first
_NEGATIVE_SLOPE = 0.2


class EdgeAttention(nn.Module):
    """A layer of equations 3.10 and 3.11 on complete graphs, several heads in parallel.

    Args:
        n_in: features of a node.
        n_edge: attributes of an edge.
        width: features per head.
        heads: heads, concatenated or, with `mean`, averaged before the ReLU.
        mean: see there.
    """

    def __init__(self, n_in: int, n_edge: int, width: int, heads: int, *, mean: bool) -> None:
        super().__init__()
        self.width, self.heads, self.mean = width, heads, mean
        self.message = nn.Linear(n_in, heads * width, bias=False)
        self.edge = nn.Linear(n_edge, heads * width, bias=False)
        self.own = nn.Linear(n_in, width if mean else heads * width)
        bound = (3.0 / width) ** 0.5
        self.attend = nn.Parameter(torch.empty(3, heads, width).uniform_(-bound, bound))

    def forward(self, nodes: Tensor, edges: Tensor, gaps: Tensor) -> Tensor:
        """New features (K, R, n, out) of nodes (K, R, n, n_in).

        `edges` (K, n, n, n_edge) lead from the second axis' other end, [i, j] from j to i, and are the same for all R
        robots; `gaps` bool (K, n, n) are true where there is none.
        """
        shape = (*nodes.shape[:3], self.heads, self.width)
        sent = self.message(nodes).view(shape)
        target, source, edge = self.attend
        by_edge = self.edge.weight.view(self.heads, self.width, -1)  # (H, w, e)
        logits = (sent * target).sum(-1).transpose(2, 3)[..., None] + (sent * source).sum(-1).transpose(2, 3)[
            ..., None, :
        ]
        scored = functional.linear(edges, (edge[:, :, None] * by_edge).sum(1))  # (K, n, n, H)
        logits = logits + scored.permute(0, 3, 1, 2)[:, None]
        missing = gaps[:, None, None]
        lowest = torch.finfo(logits.dtype).min
        alpha = functional.leaky_relu(logits, _NEGATIVE_SLOPE).masked_fill(missing, lowest).softmax(-1)
        alpha = alpha.masked_fill(missing, 0.0)  # (K, R, H, n, n)
        messages = alpha @ sent.transpose(2, 3)  # (K, R, H, n, w)
        carried = alpha.permute(0, 3, 1, 2, 4).flatten(2, 3) @ edges  # (K, n, R H, e)
        carried = carried.view(len(edges), -1, nodes.shape[1], self.heads, edges.shape[-1]).permute(0, 2, 3, 1, 4)
        messages = messages + carried @ by_edge.transpose(1, 2)
        merged = messages.mean(2) if self.mean else messages.transpose(2, 3).flatten(3)
        return functional.relu(merged + self.own(nodes))


class RoboGNNConfig(
    StepGraphConfig,
    NetworkConfig,
    Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field=NAME,
    tag="robognn",
):
    """Sizes: features per head, heads per layer, layers, and the width of the Q network's hidden layer."""

    width: Width
    heads: Heads
    layers: Layers
    hidden: Annotated[int, Meta(ge=1, le=4096)]

    def build(self, graph: GraphSpec) -> RoboGNN:
        """See NetworkConfig."""
        return RoboGNN(graph, self)


class RoboGNN(MurseStepNetwork):
    """Worths of the tasks that may be chosen, from one graph per robot.

    Args:
        spec: the metagraph, of which it reads tasks, their distances, and whose they are.
        config: sizes; published are 64 features, 8 heads, 3 layers, 64.
    """

    def __init__(self, spec: GraphSpec, config: RoboGNNConfig) -> None:
        super().__init__(spec)
        self.config = config
        n_in, stack = len(TASK) + _OWNERS, []
        for layer in range(config.layers):
            last = layer == config.layers - 1
            stack.append(EdgeAttention(n_in, len(TEMPORAL), config.width, config.heads, mean=last))
            n_in = config.width * config.heads
        self.layers = nn.ModuleList(stack)
        self.q = fully_connected(2 * config.width + len(TASK), config.hidden, 1, 2)
        explore_at_first(self.q)

    def forward(self, observation: Mapping[str, Tensor], weights: None = None) -> Tensor:
        """Worths (K, N + 2), the lowest finite number outside the action mask."""
        present, robots = observation["task_mask"] != 0, observation["agent_mask"] != 0
        tasks = observation["task"].masked_fill(~present[..., None], 0.0)
        gaps = (observation["temporal"] == 0) | ~present[:, None]
        edges = observation["temporal_attributes"].masked_fill(gaps[..., None], 0.0)
        own = (observation["assigned_to"] != 0) & robots[..., None]  # (K, R, n)
        nodes = torch.cat([tasks[:, None].expand(-1, own.shape[1], -1, -1), _owners(tasks, own)], dim=-1)
        for layer in self.layers:
            nodes = layer(nodes, edges, gaps)
        of_robot = (nodes * present[:, None, :, None]).sum(2) / present.sum(1)[:, None, None]
        state = (of_robot * robots[..., None]).sum(1) / robots.sum(1)[:, None]
        decider = observation["decider"].clamp(min=0)  # (K, n)
        action = nodes.gather(1, decider[:, None, :, None].expand(-1, 1, -1, nodes.shape[-1])).squeeze(1)
        values = torch.cat([state[:, None].expand_as(action), action, tasks], dim=-1)
        return self.corrected(self.q(values).squeeze(-1), observation)


def _owners(tasks: Tensor, own: Tensor) -> Tensor:
    """Whose tasks are for every robot, float (K, R, n, 3), from features (K, n, TASK) and bool (K, R, n)."""
    placeholder = tasks[:, None, :, TASK.index("placeholder")] != 0
    still_open = (tasks[:, None, :, TASK.index("open")] != 0).expand_as(own)
    others = ~own & ~still_open
    return torch.stack([own | placeholder, others, still_open], dim=-1).to(tasks.dtype)

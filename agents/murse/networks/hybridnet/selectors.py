"""Agent and task selector (section 5.5), which may begin at a rule's choices."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from marl_sched.agents.murse.networks.hybridnet.features import (
    AGENT_FEATURES,
    PAIR_FEATURES,
    STATE_FEATURES,
    TASK_FEATURES,
    Features,
)

Residual = Literal["none", "latest_start", "rule"]
FIRST_BETA = 3.0


class Ranks(NamedTuple):
    """The rule's order, from which residual logits follow; int64, S' is S or 1.

    Attributes:
        order: (P, S', A, N), for every agent the tasks by the rule's preference.
        place: (P, S', A, N), the inverse, where a task stands in that order.
        position: (P, S', N), place of tasks in the rule's schedule; doer: (P, S', N), who has them there.
    """

    order: Tensor
    place: Tensor
    position: Tensor
    doer: Tensor


class Board(NamedTuple):
    """What can be chosen at one moment of S schedules of each of P problems.

    Attributes:
        ready: bool (P, S, N), open tasks that await nothing that is open.
        active: bool (P, S), schedules that are not complete.
        eligible: bool (P, N, A).
        ranks: the rule's.
        now: features of the partial schedules, rows (P S); None: nobody times them.
    """

    ready: Tensor
    active: Tensor
    eligible: Tensor
    ranks: Ranks
    now: Features | None

    def candidates(self, agent: Tensor) -> Tensor:
        """Ready tasks, bool (P, S, N), for which the chosen agents, int64 (P, S), are eligible."""
        index = agent[:, None, :].expand(-1, self.eligible.shape[1], -1)
        return self.ready & self.eligible.gather(2, index).transpose(1, 2)


def ranks_of(features: Features, samples: int, residual: Residual) -> Ranks:
    """The rule's order of tasks for every agent, of rows (P, `samples`): its own tasks in the rule's schedule first."""
    n, m = features.eligible.shape[1:]
    position, doer = features.rule_position, features.rule_agent
    if residual == "rule":
        keys = position[:, None] + np.where(doer[:, None] == np.arange(m)[:, None], 0, n)
    else:
        keys = np.repeat(features.latest_rank[:, None], m, axis=1)
    order = np.argsort(keys, axis=2, kind="stable")
    place = np.argsort(order, axis=2, kind="stable")
    shaped = [torch.from_numpy(array).unflatten(0, (-1, samples)) for array in (order, place, position, doer)]
    return Ranks(*shaped)


def task_ranks(ranks: Ranks, agent: Tensor, candidates: Tensor) -> Tensor:
    """How many candidates, bool (P, S, N), the rule prefers to each task for the chosen agents, float (P, S, N)."""
    p, s, n = candidates.shape
    index = agent[:, :, None, None].expand(p, s, 1, n)
    order, place = [values.expand(p, s, -1, n).gather(2, index).squeeze(2) for values in (ranks.order, ranks.place)]
    before = candidates.gather(2, order).float().cumsum(2)
    return (before.gather(2, place) - 1.0).clamp(min=0.0)


def agent_ranks(ranks: Ranks, ready: Tensor, n_agents: int) -> Tensor:
    """How many agents the rule's schedule has begin a ready task, bool (P, S, N), sooner; float (P, S, A)."""
    late = ranks.position.shape[2]
    mine = ranks.doer[:, :, None] == torch.arange(n_agents)[:, None]  # (P, S', A, N)
    position = torch.where(mine, ranks.position[:, :, None], late)
    first = torch.where(ready[:, :, None], position, late).amin(3)  # (P, S, A)
    return (first[:, :, None] < first[:, :, :, None]).sum(3).float()


class Selectors(nn.Module):
    """Both selectors: two hidden layers each, `hidden` wide.

    With `residual` their outputs are corrections: the rule's r-th choice has -beta log(1 + r), beta learned, of the
    tasks by latest start (`latest_start`), or of agents and tasks by the rule's schedule (`rule`), and the last layers
    begin at zero, so that an untrained network schedules as the rule does. With `timed` they also read the features of
    the partial schedule (`Board.now`).
    """

    def __init__(self, *, hidden: int, edge_width: int, residual: Residual, timed: bool) -> None:
        super().__init__()
        self.residual: Residual = residual
        self.agent_own, self.agent_state = nn.Linear(hidden, hidden), nn.Linear(hidden, hidden, bias=False)
        self.task_own, self.task_pair = nn.Linear(hidden, hidden), nn.Linear(edge_width, hidden, bias=False)
        self.task_context = nn.Linear(2 * hidden, hidden, bias=False)
        self.agent_hidden, self.task_hidden = nn.Linear(hidden, hidden), nn.Linear(hidden, hidden)
        self.agent_out, self.task_out = nn.Linear(hidden, 1, bias=False), nn.Linear(hidden, 1, bias=False)
        self.log_beta = nn.Parameter(torch.full((2,), math.log(FIRST_BETA)))
        self.timed = timed
        if timed:
            self.agent_now = nn.Linear(len(AGENT_FEATURES), hidden, bias=False)
            self.state_now = nn.Linear(len(STATE_FEATURES), hidden, bias=False)
            self.task_now = nn.Linear(len(TASK_FEATURES), hidden, bias=False)
            self.pair_now = nn.Linear(len(PAIR_FEATURES), hidden, bias=False)
        if residual != "none":
            nn.init.zeros_(self.agent_out.weight)
            nn.init.zeros_(self.task_out.weight)

    def agents(self, h_agents: Tensor, h_state: Tensor, board: Board) -> Tensor:
        """Equation 5.5: logits (P, S, A) from h (P, S, A, hidden) and (P, S, hidden)."""
        p, s = board.active.shape
        both = self.agent_own(h_agents) + self.agent_state(h_state)[:, :, None]
        if self.timed and board.now is not None:
            now = self.agent_now(torch.from_numpy(board.now.agent)).unflatten(0, (p, s))
            both = both + now + self.state_now(torch.from_numpy(board.now.state)).view(p, s, 1, -1)
        logits = self.agent_out(torch.relu(self.agent_hidden(torch.relu(both)))).squeeze(-1)
        if self.residual == "rule":
            ranks = agent_ranks(board.ranks, board.ready, logits.shape[2])
            logits = logits - self.log_beta[0].exp() * torch.log1p(ranks)
        return logits

    def tasks(self, own: Tensor, h_agent: Tensor, h_state: Tensor, board: Board, agent: Tensor) -> Tensor:
        """Equation 5.6: logits (P, S, N); `own` (P, S, N, hidden) is what tasks and pairs bring to the first layer."""
        p, s = board.active.shape
        both = own + self.task_context(torch.cat([h_agent, h_state], -1))[:, :, None]
        if self.timed and board.now is not None:
            pairs = of_agent(torch.from_numpy(board.now.pair), agent.flatten()[:, None]).squeeze(1)
            now = self.task_now(torch.from_numpy(board.now.task)) + self.pair_now(pairs)
            both = both + now.unflatten(0, (p, s))
        logits = self.task_out(torch.relu(self.task_hidden(torch.relu(both)))).squeeze(-1)
        if self.residual != "none":
            ranks = task_ranks(board.ranks, agent, board.candidates(agent))
            logits = logits - self.log_beta[1].exp() * torch.log1p(ranks)
        return logits


def of_agent(pairs: Tensor, agent: Tensor) -> Tensor:
    """Of values (P, N, A, k) those of the chosen agents, int64 (P, S): (P, S, N, k)."""
    p, n, _, k = pairs.shape
    index = agent[:, :, None, None].expand(p, agent.shape[1], n, k)
    return pairs.transpose(1, 2).gather(1, index)


def pick(values: Tensor, index: Tensor) -> Tensor:
    """Of values (P, S, n, k) those at int64 (P, S): (P, S, k)."""
    return values.gather(2, index[:, :, None, None].expand(-1, -1, 1, values.shape[3])).squeeze(2)

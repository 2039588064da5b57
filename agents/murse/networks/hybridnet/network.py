"""HybridNet and the interactive HetGAT as networks that choose an agent, then a task for it (sections 5.4, 5.5, 5.7).

HybridNet encodes a round once. A schedule is a sequence of pairs (equation 5.3); for each the agent selector gives
every agent a logit from [h_a || h_s], the task selector every task one from [h_tau || h_a || h_s || z_(tau, a)], z
being the pair's deep edge embedding; then the chosen agent's (h_a, c_a) and the state's (h_s, c_s) go through LSTM
cells on [h_tau || h_a || z] (algorithm 3). What the published code does otherwise is not repeated: the agent's cell is
written back, a lone candidate is propagated too, and no row shifts. The dissertation has no z in selectors and cells.

Two options go beyond it: `residual` lets selectors correct a rule (`Selectors`), and `timed` times the partial schedule
after every pair, lets the rule complete it anew, and shows the selectors what that gives. The encoder still runs once.

InteractiveHetGAT has no cells. It times the partial schedule after every pair and encodes it anew.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from marl_sched.agents.murse.networks.hybridnet.encoder import AGENT, STATE, TASK, DeepEdgeEncoder, graph_of
from marl_sched.agents.murse.networks.hybridnet.features import Features
from marl_sched.agents.murse.networks.hybridnet.selectors import Board, Residual, Selectors, of_agent, pick


class PairNetwork(nn.Module):
    """What the decoder asks of a network.

    Attributes:
        timed: whether it reads partial schedules (`Board.now`).
        residual: see Selectors.
    """

    timed: bool
    selectors: Selectors

    @property
    def residual(self) -> Residual:
        """What its logits begin at."""
        return self.selectors.residual

    def begin(self, features: Features, samples: int) -> Any:
        """The memory with which `samples` schedules of every round begin, from features of empty schedules."""
        raise NotImplementedError(type(self).__name__)

    def at(self, memory: Any, board: Board) -> Any:
        """The memory when the partial schedules are those of `board`, before a pair is chosen; here the same."""
        return memory

    def agent_logits(self, memory: Any, board: Board) -> Tensor:
        """(P, S, A)."""
        raise NotImplementedError(type(self).__name__)

    def task_logits(self, memory: Any, board: Board, agent: Tensor) -> Tensor:
        """(P, S, N) for the chosen agents, int64 (P, S)."""
        raise NotImplementedError(type(self).__name__)

    def advance(self, memory: Any, board: Board, agent: Tensor, task: Tensor) -> Any:
        """The memory after the pairs of the active schedules, int64 (P, S) each; here the same."""
        return memory


class Propagated(NamedTuple):
    """HybridNet's memory: what was encoded once, and the cells of P x S schedules.

    Attributes:
        tasks: (P, N, hidden), pairs: (P, N, A, edge_width).
        own: (P, N, hidden), the selector's part of tasks, own_pairs: (P, N, A, hidden), that of pairs.
        h_agents, c_agents: (P, S, A, hidden); h_state, c_state: (P, S, hidden).
    """

    tasks: Tensor
    pairs: Tensor
    own: Tensor
    own_pairs: Tensor
    h_agents: Tensor
    c_agents: Tensor
    h_state: Tensor
    c_state: Tensor


class Propagator(PairNetwork):
    """HybridNet's encoder, cells and selectors; see the page.

    Args:
        width, heads, layers: of the encoder.
        hidden: of LSTM cells and selectors.
        edge_width: of edge embeddings.
        residual, timed: see the page.
    """

    def __init__(
        self, *, width: int, heads: int, layers: int, hidden: int, edge_width: int, residual: Residual, timed: bool
    ) -> None:
        super().__init__()
        outputs = {TASK: hidden, AGENT: 2 * hidden, STATE: 2 * hidden}
        self.hidden, self.timed = hidden, timed
        self.encoder = DeepEdgeEncoder(width=width, heads=heads, edge_width=edge_width, layers=layers, outputs=outputs)
        self.selectors = Selectors(hidden=hidden, edge_width=edge_width, residual=residual, timed=timed)
        self.agent_cell = nn.LSTMCell(2 * hidden + edge_width, hidden)
        self.state_cell = nn.LSTMCell(2 * hidden + edge_width, hidden)

    def begin(self, features: Features, samples: int) -> Propagated:
        """Encode every round once."""
        nodes, pairs = self.encoder(graph_of(features))
        h_agents, c_agents = nodes[AGENT][:, None].expand(-1, samples, -1, -1).split(self.hidden, -1)
        h_state, c_state = nodes[STATE].expand(-1, samples, -1).split(self.hidden, -1)
        own, own_pairs = self.selectors.task_own(nodes[TASK]), self.selectors.task_pair(pairs)
        h_agents, h_state = torch.tanh(h_agents), torch.tanh(h_state)
        return Propagated(nodes[TASK], pairs, own, own_pairs, h_agents, c_agents, h_state, c_state)

    def agent_logits(self, memory: Propagated, board: Board) -> Tensor:
        """See PairNetwork."""
        return self.selectors.agents(memory.h_agents, memory.h_state, board)

    def task_logits(self, memory: Propagated, board: Board, agent: Tensor) -> Tensor:
        """See PairNetwork."""
        own = memory.own[:, None] + of_agent(memory.own_pairs, agent)
        return self.selectors.tasks(own, pick(memory.h_agents, agent), memory.h_state, board, agent)

    def advance(self, memory: Propagated, board: Board, agent: Tensor, task: Tensor) -> Propagated:
        """Lines 14 and 15 of algorithm 3; schedules that are complete stay as they are."""
        p, s = agent.shape
        h_task = memory.tasks.gather(1, task[:, :, None].expand(-1, -1, self.hidden))
        places = (task * memory.pairs.shape[2] + agent)[:, :, None].expand(-1, -1, memory.pairs.shape[3])
        pair = memory.pairs.flatten(1, 2).gather(1, places)
        h_agent, c_agent = pick(memory.h_agents, agent), pick(memory.c_agents, agent)
        x = torch.cat([h_task, h_agent, pair], -1).flatten(0, 1)
        new_h, new_c = self.agent_cell(x, (h_agent.flatten(0, 1), c_agent.flatten(0, 1)))
        h_state, c_state = self.state_cell(x, (memory.h_state.flatten(0, 1), memory.c_state.flatten(0, 1)))
        chosen = torch.arange(memory.h_agents.shape[2]) == agent[:, :, None]
        chosen = (chosen & board.active[:, :, None])[..., None]
        active = board.active[:, :, None]
        return memory._replace(
            h_agents=torch.where(chosen, new_h.view(p, s, 1, -1), memory.h_agents),
            c_agents=torch.where(chosen, new_c.view(p, s, 1, -1), memory.c_agents),
            h_state=torch.where(active, h_state.view(p, s, -1), memory.h_state),
            c_state=torch.where(active, c_state.view(p, s, -1), memory.c_state),
        )


class Encoded(NamedTuple):
    """What the interactive encoder makes of P x S partial schedules.

    Attributes:
        tasks: (P, S, N, hidden), agents: (P, S, A, hidden), state: (P, S, hidden), pairs: (P S, N, A, edge_width).
    """

    tasks: Tensor
    agents: Tensor
    state: Tensor
    pairs: Tensor


class Interactive(PairNetwork):
    """HetGAT as a scheduler: after every pair the round is encoded anew. Arguments as Propagator's."""

    timed = True

    def __init__(
        self, *, width: int, heads: int, layers: int, hidden: int, edge_width: int, residual: Residual
    ) -> None:
        super().__init__()
        outputs = dict.fromkeys((TASK, AGENT, STATE), hidden)
        self.encoder = DeepEdgeEncoder(width=width, heads=heads, edge_width=edge_width, layers=layers, outputs=outputs)
        self.selectors = Selectors(hidden=hidden, edge_width=edge_width, residual=residual, timed=True)

    def begin(self, features: Features, samples: int) -> None:
        """Nothing is carried on."""

    def at(self, memory: None, board: Board) -> Encoded:
        """Encode the partial schedules."""
        assert board.now is not None  # it is `timed`
        nodes, pairs = self.encoder(graph_of(board.now))
        shaped = {name: values.unflatten(0, board.active.shape) for name, values in nodes.items()}
        return Encoded(shaped[TASK], shaped[AGENT], shaped[STATE][:, :, 0], pairs)

    def agent_logits(self, memory: Encoded, board: Board) -> Tensor:
        """See PairNetwork."""
        return self.selectors.agents(memory.agents, memory.state, board)

    def task_logits(self, memory: Encoded, board: Board, agent: Tensor) -> Tensor:
        """See PairNetwork."""
        pairs = self.selectors.task_pair(of_agent(memory.pairs, agent.flatten()[:, None]).squeeze(1))
        own = self.selectors.task_own(memory.tasks) + pairs.unflatten(0, board.active.shape)
        return self.selectors.tasks(own, pick(memory.agents, agent), memory.state, board, agent)

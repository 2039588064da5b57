"""Drawing schedules from a network that chooses pairs: greedily, by sampling, or as they are given (teacher forcing).

All three are one loop over pairs, for S schedules of each of P problems at once. A task can be chosen once all that it
waits for has been; an agent, while it is eligible for such a task. A lone candidate is chosen and propagated like any
other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from marl_sched.agents.murse.networks.hybridnet.features import Features, features_of
from marl_sched.agents.murse.networks.hybridnet.network import PairNetwork
from marl_sched.agents.murse.networks.hybridnet.pair_costs import pair_costs
from marl_sched.agents.murse.networks.hybridnet.rounds import Rounds, insert, nothing_dispatched
from marl_sched.agents.murse.networks.hybridnet.selectors import Board, ranks_of
from marl_sched.agents.networks.sequences import Drawn

TASK, AGENT = 0, 1  # of a pair


@dataclass(frozen=True)
class Chooser:
    """How entries are chosen: as `given`, int64 (P, S, N, 2), by `uniforms`, float64 (P, S, N, 2), or greedily."""

    given: Tensor | None
    uniforms: Tensor | None

    def __call__(self, log_probs: Tensor, k: int, part: int) -> Tensor:
        """Int64 (P, S) of (P, S, n) log-probabilities, at pair k, TASK or AGENT. Ties go to the lower index."""
        if self.given is not None:
            return self.given[:, :, k, part]
        if self.uniforms is None:
            return log_probs.argmax(2)
        probs = log_probs.detach().double().exp()
        share = self.uniforms[:, :, k, part, None] * probs.sum(2, keepdim=True)
        index = (probs.cumsum(2) <= share).sum(2)
        last = ((probs > 0).int() * torch.arange(1, probs.shape[2] + 1)).amax(2).long() - 1
        return torch.minimum(index, last)  # rounding must not lead behind the last that is allowed


def draw_pairs(
    network: PairNetwork,
    rounds: Rounds,
    samples: int = 1,
    *,
    uniforms: np.ndarray | None = None,
    given: np.ndarray | None = None,
    seen: list[Features] | None = None,
    appraise: bool = False,
) -> Drawn:
    """Schedules of all rounds, see SequenceNetwork.draw: choices are pairs (task, agent).

    `seen` are the features of the partial schedules before each pair, for a network that is `timed`; they are worked
    out here if not given. To `appraise` is to say what the rule would complete them for. Given schedules must be
    possible, or their log-probabilities are very low.
    """
    walk = _Walk(network, rounds, samples, seen, timed=network.timed or appraise)
    choose = Chooser(*[None if array is None else torch.from_numpy(array) for array in (given, uniforms)])
    zero, steps, entropies = torch.zeros(walk.undone.shape[:2]), [], []
    orders = np.zeros((*walk.undone.shape, 2), np.int64)
    for k in range(walk.length):
        board = walk.board(k)
        log_agent = walk.agent_log_probs(board)
        agent = choose(log_agent, k, AGENT)
        log_task = walk.task_log_probs(board, agent)
        task = choose(log_task, k, TASK)
        both = log_agent.gather(2, agent[..., None]) + log_task.gather(2, task[..., None])
        steps.append(torch.where(board.active, both.squeeze(2), zero))
        entropies.append(torch.where(board.active, entropy(log_agent) + entropy(log_task), zero))
        orders[:, :, k, TASK], orders[:, :, k, AGENT] = task.numpy(), agent.numpy()
        walk.take(k, board, agent, task)
    orders *= (np.arange(rounds.shape[1]) < rounds.sizes[:, :1])[:, None, :, None]
    partials = walk.partials
    return Drawn(
        orders=orders,
        log_probs=torch.stack(steps, 2),
        entropies=torch.stack(entropies).sum(0),
        lengths=rounds.sizes[:, 0],
        seen=partials.features if partials is not None and network.timed else None,
        appraisals=partials.appraisals(len(rounds.sizes)) if partials is not None and appraise else None,
    )


def pair_log_probs(
    network: PairNetwork, rounds: Rounds, given: np.ndarray, seen: list[Features] | None = None
) -> Tensor:
    """Log-probabilities of all pairs that could be next along given schedules, int64 (P, S, N, 2): (P, S, L, A N).

    The lowest finite number for those that cannot; L is the most tasks that a round has.
    """
    walk = _Walk(network, rounds, given.shape[1], seen, timed=network.timed)
    chosen, found = torch.from_numpy(given), []
    m = rounds.shape[2]
    for k in range(walk.length):
        board = walk.board(k)
        log_agent = walk.agent_log_probs(board)
        every = [walk.task_log_probs(board, torch.full(log_agent.shape[:2], agent)) for agent in range(m)]
        both = log_agent[..., None] + torch.stack(every, 2)
        found.append(both.clamp(min=torch.finfo(both.dtype).min).flatten(2))
        walk.take(k, board, chosen[:, :, k, AGENT], chosen[:, :, k, TASK])
    return torch.stack(found, 2)


def costs_along(rounds: Rounds, given: np.ndarray) -> np.ndarray:
    """What all pairs that could be next along given schedules cost (`pair_costs`), float64 (P, S, L, A N)."""
    p, samples, n, _ = given.shape
    several = rounds.take(np.repeat(np.arange(p), samples))
    partial, orders, found = nothing_dispatched(several), given.reshape(p * samples, n, 2), []
    for k in range(int(rounds.sizes[:, 0].max())):
        found.append(pair_costs(several, partial).reshape(p, samples, -1))
        insert(several, partial, orders[:, k, TASK], orders[:, k, AGENT], k < several.sizes[:, 0])
    return np.stack(found, axis=2)


class _Walk:
    """Through S schedules of each of P rounds, pair by pair.

    Attributes:
        length: pairs of the longest schedule.
        undone: bool (P, S, N); partials: partial schedules, where somebody reads them.
    """

    def __init__(
        self, network: PairNetwork, rounds: Rounds, samples: int, seen: list[Features] | None, *, timed: bool
    ) -> None:
        n, first = rounds.shape[1], features_of(rounds, nothing_dispatched(rounds))
        self._network, self._samples, self.length = network, samples, int(rounds.sizes[:, 0].max())
        self.partials = _Partials(rounds, samples, seen) if timed else None
        self._eligible, self._waits = torch.from_numpy(first.eligible), torch.from_numpy(first.waits)
        self.undone = (torch.arange(n) < torch.from_numpy(rounds.sizes[:, :1]))[:, None].repeat(1, samples, 1)
        self._missing = self._waits.sum(2)[:, None].repeat(1, samples, 1)
        self._ranks, self._memory = ranks_of(first, 1, network.residual), network.begin(first, samples)

    def board(self, k: int) -> Board:
        """What can be chosen at pair k."""
        now = None if self.partials is None else self.partials.at(k)
        if self._network.timed and now is not None:
            self._ranks = ranks_of(now, self._samples, self._network.residual)
        ready, active = self.undone & (self._missing == 0), self.undone.any(2)
        board = Board(ready, active, self._eligible, self._ranks, now if self._network.timed else None)
        self._memory = self._network.at(self._memory, board)
        return board

    def agent_log_probs(self, board: Board) -> Tensor:
        """(P, S, A), of agents that are eligible for something that is ready."""
        able = (board.ready.float() @ self._eligible.float()) > 0
        return masked_log_probs(self._network.agent_logits(self._memory, board), able)

    def task_log_probs(self, board: Board, agent: Tensor) -> Tensor:
        """(P, S, N), of what is ready for the chosen agents, int64 (P, S)."""
        return masked_log_probs(self._network.task_logits(self._memory, board, agent), board.candidates(agent))

    def take(self, k: int, board: Board, agent: Tensor, task: Tensor) -> None:
        """Go on with these pairs, int64 (P, S) each; nothing is propagated behind the last one."""
        n = self.undone.shape[2]
        taken = (torch.arange(n) == task[:, :, None]) & board.active[:, :, None]
        self.undone = self.undone & ~taken
        behind = self._waits.transpose(1, 2).gather(1, task[:, :, None].expand(-1, -1, n))
        self._missing = self._missing - behind.long()
        if self.partials is not None:
            self.partials.insert(task, agent, board.active)
        if k + 1 < self.length:
            self._memory = self._network.advance(self._memory, board, agent, task)


class _Partials:
    """Partial schedules of P x S rows on the way, or what was seen of them before."""

    def __init__(self, rounds: Rounds, samples: int, seen: list[Features] | None) -> None:
        self.features: list[Features] = [] if seen is None else seen
        self._known = seen is not None
        self._rounds = rounds.take(np.repeat(np.arange(len(rounds.sizes)), samples))
        self._partial = nothing_dispatched(self._rounds)

    def at(self, k: int) -> Features:
        if not self._known:
            self.features.append(features_of(self._rounds, self._partial))
        return self.features[k]

    def insert(self, task: Tensor, agent: Tensor, active: Tensor) -> None:
        if not self._known:
            insert(self._rounds, self._partial, *[values.flatten().numpy() for values in (task, agent, active)])

    def appraisals(self, problems: int) -> np.ndarray:
        """What the rule would complete schedules for before each pair and at the end, float64 (P, S, L + 1)."""
        last = features_of(self._rounds, self._partial)
        costs = [features.rule_cost for features in (*self.features, last)]
        return np.stack(costs, axis=1).reshape(problems, -1, len(costs))


def masked_log_probs(logits: Tensor, mask: Tensor) -> Tensor:
    """Log-softmax over what the mask allows, the lowest finite number elsewhere; uniform where it allows nothing."""
    lowest = torch.finfo(logits.dtype).min
    return torch.where(mask, logits, lowest).log_softmax(-1).clamp(min=lowest)


def entropy(log_probs: Tensor) -> Tensor:
    """Of distributions (P, S, n), (P, S)."""
    return -(log_probs.exp() * log_probs).sum(2)

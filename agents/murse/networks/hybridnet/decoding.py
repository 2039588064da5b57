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
    p, n, _ = rounds.shape
    length = int(rounds.sizes[:, 0].max())
    first = features_of(rounds, nothing_dispatched(rounds))
    stepwise = _Partials(rounds, samples, seen) if network.timed or appraise else None
    choose = Chooser(*[None if array is None else torch.from_numpy(array) for array in (given, uniforms)])
    eligible, waits = torch.from_numpy(first.eligible), torch.from_numpy(first.waits)
    undone = (torch.arange(n) < torch.from_numpy(rounds.sizes[:, :1]))[:, None].repeat(1, samples, 1)
    missing = waits.sum(2)[:, None].repeat(1, samples, 1)
    ranks, memory = ranks_of(first, 1, network.residual), network.begin(first, samples)
    zero = torch.zeros(p, samples)
    steps, entropies, orders = [], [], np.zeros((p, samples, n, 2), np.int64)
    for k in range(length):
        now = None if stepwise is None else stepwise.at(k)
        if network.timed and now is not None:
            ranks = ranks_of(now, samples, network.residual)
        board = Board(undone & (missing == 0), undone.any(2), eligible, ranks, now if network.timed else None)
        memory = network.at(memory, board)
        able = (board.ready.float() @ eligible.float()) > 0
        log_agent = masked_log_probs(network.agent_logits(memory, board), able)
        agent = choose(log_agent, k, AGENT)
        log_task = masked_log_probs(network.task_logits(memory, board, agent), board.candidates(agent))
        task = choose(log_task, k, TASK)
        both = log_agent.gather(2, agent[..., None]) + log_task.gather(2, task[..., None])
        steps.append(torch.where(board.active, both.squeeze(2), zero))
        entropies.append(torch.where(board.active, entropy(log_agent) + entropy(log_task), zero))
        orders[:, :, k, TASK], orders[:, :, k, AGENT] = task.numpy(), agent.numpy()
        taken = (torch.arange(n) == task[:, :, None]) & board.active[:, :, None]
        undone = undone & ~taken
        missing = missing - waits.transpose(1, 2).gather(1, task[:, :, None].expand(-1, -1, n)).long()
        if stepwise is not None:
            stepwise.insert(task, agent, board.active)
        if k + 1 < length:
            memory = network.advance(memory, board, agent, task)
    orders *= (np.arange(n) < rounds.sizes[:, :1])[:, None, :, None]
    return Drawn(
        orders=orders,
        log_probs=torch.stack(steps, 2),
        entropies=torch.stack(entropies).sum(0),
        lengths=rounds.sizes[:, 0],
        seen=stepwise.features if stepwise is not None and network.timed else None,
        appraisals=stepwise.appraisals(p, length) if stepwise is not None and appraise else None,
    )


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

    def appraisals(self, problems: int, length: int) -> np.ndarray:
        """What the rule would complete schedules for before each pair and at the end, float64 (P, S, length + 1)."""
        last = features_of(self._rounds, self._partial)
        costs = [features.rule_cost for features in (*self.features[:length], last)]
        return np.stack(costs, axis=1).reshape(problems, -1, length + 1)


def masked_log_probs(logits: Tensor, mask: Tensor) -> Tensor:
    """Log-softmax over what the mask allows, the lowest finite number elsewhere; uniform where it allows nothing."""
    lowest = torch.finfo(logits.dtype).min
    return torch.where(mask, logits, lowest).log_softmax(-1).clamp(min=lowest)


def entropy(log_probs: Tensor) -> Tensor:
    """Of distributions (P, S, n), (P, S)."""
    return -(log_probs.exp() * log_probs).sum(2)

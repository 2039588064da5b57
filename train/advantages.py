"""How good choices were: estimators to choose from, along the team's sequence of turns or along an agent's own.

Time passes only when all agents that are free have acted, so discounting is semi-Markov: a turn that lets
e units of simulated time pass discounts what follows by gamma ** e, and by 1 within a decision epoch.
Turns that are not valid (after an episode's end, or at its cut) may hold anything, NaN included, and get 0.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate


def generalised_advantages(
    rewards: Tensor,
    elapsed: Tensor,
    values: Tensor,
    valid: Tensor,
    alive: Tensor,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """Generalised advantage estimates (Schulman et al. 2016) and value targets, float64 (T, B).

    Args:
        rewards: float (T, B), what a turn brought.
        elapsed: int or float (T, B), the simulated time that it let pass.
        values: float (T + 1, B), of the states in which turns were taken and of the last one reached.
        valid: bool (T + 1, B), the turn was taken; an estimate reaches over valid turns only.
        alive: bool (T + 1, B), the state has a future: its value counts even where no turn was taken in it,
            as at the cut of an episode that could have gone on.
        discount: gamma, per unit of simulated time.
        gae_lambda: lambda, per unit of simulated time: how far credit reaches does not depend on how many agents
            act at a decision epoch.
    """
    taken = valid[:-1]
    passed = torch.where(taken, elapsed.double(), 0.0)
    values = torch.where(alive, values.double(), 0.0)
    advantages, targets = generalized_advantage_estimate(
        gamma=discount**passed,
        lmbda=gae_lambda**passed,
        state_value=values[:-1],
        next_state_value=values[1:],
        reward=torch.where(taken, rewards.double(), 0.0),
        done=~valid[1:],
        terminated=~alive[1:],
    )
    return torch.where(taken, advantages, 0.0), torch.where(taken, targets, 0.0)


def own_turn_advantages(
    rewards: Tensor,
    elapsed: Tensor,
    values: Tensor,
    agents: Tensor,
    valid: Tensor,
    alive: Tensor,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Generalised advantage estimates along each agent's own turns, as independent learners have them (IPPO).

    To an agent a turn lasts until its next own one. It earns all that the team does in between, discounted to the
    turn's decision epoch, and what follows is discounted by gamma to the power of the time between.

    At a cut and at the segment's end only one agent is about to act; the value of the others' future is not known.
    An agent's last turn before it therefore is not learned from, it only serves the turn before as its future; where
    an episode truly ends nothing is lost. A turn after which an agent is busy for long is lost more often, so a
    segment should be many jobs long.

    `agents` int64 (T + 1, B) says who was to act, -1 where nobody was; the other arguments are as for
    `generalised_advantages`. Returns advantages and value targets, float64 (T, B), and bool
    (T, B), which turns are to be learned from.
    """
    turns, batch = rewards.shape
    rows, owner = torch.arange(batch), agents.clamp(min=0)
    values = torch.where(alive, values.double(), 0.0)
    advantages, targets = torch.zeros(2, turns, batch, dtype=torch.float64)
    loss_mask = torch.zeros(turns, batch, dtype=torch.bool)
    # of each agent, (B, A): its next own turn's value and advantage, what is earned and how long it takes until then
    following, credit, earned, passed = torch.zeros(4, batch, int(owner.max()) + 1, dtype=torch.float64)
    known = torch.zeros_like(following, dtype=torch.bool)  # that value is known; an end's is 0
    for t in reversed(range(turns + 1)):
        taken = valid[t] if t < turns else torch.zeros_like(valid[t])
        for books in (following, credit, earned, passed):
            books[~taken] = 0.0
        known[~taken] = ~alive[t, ~taken, None]
        who = owner[t]
        if t < turns:
            span = torch.where(taken, elapsed[t].double(), 0.0)[:, None]
            earned = torch.where(taken, rewards[t].double(), 0.0)[:, None] + discount**span * earned
            passed = passed + span
            loss_mask[t] = taken & known[rows, who]
            discounted = discount ** passed[rows, who]
            target = earned[rows, who] + discounted * following[rows, who]
            target = target + discounted * gae_lambda ** passed[rows, who] * credit[rows, who]
            advantages[t] = torch.where(loss_mask[t], target - values[t], 0.0)
            targets[t] = torch.where(loss_mask[t], target, 0.0)
            credit[rows, who] = advantages[t]
        following[rows, who] = values[t]
        known[rows, who] |= taken | alive[t]
        earned[rows, who] = passed[rows, who] = 0.0
    return advantages, targets, loss_mask


def returns_by_time(
    rewards: Tensor, elapsed: Tensor, times: Tensor, valid: Tensor, *, discount: float, length: int
) -> Tensor:
    """Rewards-to-go at every unit of simulated time, float64 (length, B): line 18 of algorithm 5.

    `times` (T, B) int64 is when turns were taken, the others are as for `generalised_advantages`. What a
    turn brought is spread evenly over the time that it let pass; what lies beyond `length` is left out, and
    an episode that ended early earns nothing for the rest.
    """
    batch = rewards.shape[1]
    earned = torch.zeros(length, batch, dtype=torch.float64)
    rate = torch.where(valid & (elapsed > 0), rewards.double() / elapsed.clamp(min=1), 0.0)
    span = torch.where(valid, elapsed, 0)
    for offset in range(int(span.max())):
        at_time = times + offset
        inside = (offset < span) & (at_time < length)
        earned.scatter_add_(0, torch.where(inside, at_time, 0), torch.where(inside, rate, 0.0))
    to_go = torch.zeros(batch, dtype=torch.float64)
    returns = torch.empty_like(earned)
    for t in reversed(range(length)):
        to_go = earned[t] + discount * to_go
        returns[t] = to_go
    return returns


def step_baseline_advantages(
    rewards: Tensor, elapsed: Tensor, times: Tensor, valid: Tensor, *, discount: float, length: int, episodes: int
) -> Tensor:
    """Rewards-to-go less their mean over the episodes of an instance at the same time, float64 (T, B).

    Line 19 of algorithm 5. Rows i * episodes to (i + 1) * episodes - 1 are the episodes of instance i;
    the other arguments are as for `returns_by_time`.
    """
    returns = returns_by_time(rewards, elapsed, times, valid, discount=discount, length=length)
    grouped = returns.unflatten(1, (-1, episodes))
    advantages = (grouped - grouped.mean(2, keepdim=True)).flatten(1)
    inside = valid & (times < length)
    return torch.where(inside, advantages.gather(0, torch.where(inside, times, 0)), 0.0)


def normalised(advantages: Tensor, valid: Tensor) -> Tensor:
    """Advantages (T, B) with mean 0 and standard deviation 1 over the valid turns, 0 elsewhere."""
    loss_mask = advantages[valid]
    scaled = (advantages - loss_mask.mean()) / (loss_mask.std(correction=0) + 1e-8)
    return torch.where(valid, scaled, 0.0)

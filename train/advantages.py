"""How good choices were: estimators to choose from, along the team's sequence of turns or along an agent's own.

Time passes only when all agents that are free have acted, so discounting is semi-Markov: a turn that lets
e units of simulated time pass discounts what follows by gamma ** e, and by 1 within a decision epoch. TorchRL's value
estimators know one discount for all steps, so discounts are worked out here and its functional form is called.
What is not valid (a turn after an episode's end, the value of a state without a future) may be anything, NaN included.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate


def generalised_advantages(
    rewards: Tensor,
    elapsed: Tensor,
    values: Tensor,
    next_values: Tensor,
    boundary: Tensor,
    terminated: Tensor,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """Generalised advantage estimates (Schulman et al. 2016) and value targets, float64 (T, B).

    Args:
        rewards: float (T, B), what a turn brought.
        elapsed: int or float (T, B), the simulated time that it let pass.
        values: float (T, B), of the states in which turns were taken.
        next_values: float (T, B), of the states that they led to.
        boundary: bool (T, B), no later turn goes on from this one: an end, a cut, or the last of the rollout.
        terminated: bool (T, B), the episode ended with the turn: what it led to has no value.
        discount: gamma, per unit of simulated time.
        gae_lambda: lambda, per unit of simulated time: how far credit reaches does not depend on how many agents
            act at a decision epoch.
    """
    passed = elapsed.double()
    advantages, targets = generalized_advantage_estimate(
        gamma=discount**passed,
        lmbda=gae_lambda**passed,
        state_value=values.double(),
        next_state_value=torch.where(terminated, 0.0, next_values.double()),
        reward=rewards.double(),
        done=boundary,
        terminated=terminated,
    )
    return advantages, targets


def own_turn_advantages(
    rewards: Tensor,
    elapsed: Tensor,
    values: Tensor,
    next_values: Tensor,
    agents: Tensor,
    next_agents: Tensor,
    boundary: Tensor,
    terminated: Tensor,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Generalised advantage estimates along each agent's own turns, as independent learners have them (IPPO).

    To an agent a turn lasts until its next own one. It earns all that the team does in between, discounted to the
    turn's decision epoch, and what follows is discounted by gamma to the power of the time between.

    At a cut and at the rollout's end only one agent is about to act; the value of the others' future is not known.
    An agent's last turn before it therefore is not learned from, it only serves the turn before as its future; where
    an episode truly ends nothing is lost. A turn after which an agent is busy for long is lost more often, so a
    rollout should be many jobs long.

    `agents` and `next_agents` int64 (T, B) say whose turn it was and who is to act next; the other arguments are as for
    `generalised_advantages`. Returns advantages and value targets, float64 (T, B), and bool
    (T, B), which turns are to be learned from.
    """
    turns, batch = rewards.shape
    rows, count = torch.arange(batch), int(torch.maximum(agents, next_agents).max()) + 1
    values, next_values = values.double(), torch.where(terminated, 0.0, next_values.double())
    advantages, targets = torch.zeros(2, turns, batch, dtype=torch.float64)
    loss_mask = torch.zeros(turns, batch, dtype=torch.bool)
    # of each agent, (B, A): its next own turn's value and advantage, what is earned and how long it takes until then
    following, credit, earned, passed = torch.zeros(4, batch, max(count, 1), dtype=torch.float64)
    known = torch.zeros_like(following, dtype=torch.bool)  # that value is known; an end's is 0
    for t in reversed(range(turns)):
        last = boundary[t]
        for account in (following, credit, earned, passed):
            account[last] = 0.0
        known[last] = terminated[t, last, None]
        cut, heir = last & ~terminated[t], next_agents[t].clamp(min=0)
        following[rows, heir] = torch.where(cut, next_values[t], following[rows, heir])
        known[rows, heir] |= cut
        who, span = agents[t].clamp(min=0), elapsed[t].double()[:, None]
        earned = rewards[t].double()[:, None] + discount**span * earned
        passed = passed + span
        loss_mask[t] = (agents[t] >= 0) & known[rows, who]
        discounted = discount ** passed[rows, who]
        target = earned[rows, who] + discounted * following[rows, who]
        target = target + discounted * gae_lambda ** passed[rows, who] * credit[rows, who]
        advantages[t] = torch.where(loss_mask[t], target - values[t], 0.0)
        targets[t] = torch.where(loss_mask[t], target, 0.0)
        credit[rows, who] = advantages[t]
        following[rows, who], known[rows, who] = values[t], True
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

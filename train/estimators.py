"""Advantage estimators as parts of a run: each turns a rollout into advantages and, with a critic, value targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from marl_sched.train.advantages import generalised_advantages, own_turn_advantages, step_baseline_advantages
from marl_sched.train.collect import Rollout
from marl_sched.train.device import device_of

_RATE_STEP = 0.2  # of the exponential average of the reward rate


@dataclass(frozen=True)
class Estimate:
    """What a rollout's turns were worth.

    Attributes:
        advantages: float64 (T, B).
        value_targets: float64 (T, B), None without a critic.
        explained_variance: how much of the targets' variance the critic explains.
        loss_mask: bool (T, B), turns to learn from, all of them valid.
    """

    advantages: Tensor
    value_targets: Tensor | None
    explained_variance: float
    loss_mask: Tensor


class Estimator(Protocol):
    """What the training loop asks for."""

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages of a rollout's turns, zero where a turn is not to be learned from."""

    def state(self) -> dict[str, float | None]:
        """What a resumed run needs, as JSON."""

    def restore(self, state: dict[str, float | None]) -> None:
        """Go on from a saved state."""


class CriticEstimator:
    """Generalised advantages from a critic that is given the full graph.

    The average reward rate is subtracted from rewards ("reward centring"; Naik et al. 2024), so that values
    say how much better than usual a state is, a few units, and not what a hundred hours are worth. In a
    problem whose episodes end by themselves that would change what is best; there `reward_centering` must be False.
    """

    def __init__(self, critic: nn.Module, *, discount: float, gae_lambda: float, reward_centering: bool) -> None:
        self._critic, self._discount, self._gae_lambda, self._reward_centering = (
            critic,
            discount,
            gae_lambda,
            reward_centering,
        )
        self._rate: float | None = None

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages and value targets."""
        rate = 0.0
        if self._reward_centering:
            seen = rollout.reward_rate
            rate = seen if self._rate is None else self._rate + _RATE_STEP * (seen - self._rate)
            self._rate = rate
        values = values_of(self._critic, rollout)
        advantages, targets, loss_mask = self._credit(rollout, rollout.rewards - rate * rollout.elapsed, values)
        return Estimate(advantages, targets, explained_variance(targets, values[:-1], loss_mask), loss_mask)

    def _credit(self, rollout: Rollout, rewards: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Advantages, value targets and the turns to learn from, (T, B) each."""
        advantages, targets = generalised_advantages(
            rewards,
            rollout.elapsed,
            values,
            rollout.valid,
            rollout.alive,
            discount=self._discount,
            gae_lambda=self._gae_lambda,
        )
        return advantages, targets, rollout.valid[:-1]

    def state(self) -> dict[str, float | None]:
        """The reward rate."""
        return {"reward_rate": self._rate}

    def restore(self, state: dict[str, float | None]) -> None:
        """The reward rate."""
        self._rate = state["reward_rate"]


class OwnTurns(CriticEstimator):
    """Independent learners (IPPO): generalised advantages along each agent's own turns (`own_turn_advantages`).

    For rollouts without a central graph, in which the critic sees what the acting agent does.
    """

    def _credit(self, rollout: Rollout, rewards: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return own_turn_advantages(
            rewards,
            rollout.elapsed,
            values,
            rollout.agents,
            rollout.valid,
            rollout.alive,
            discount=self._discount,
            gae_lambda=self._gae_lambda,
        )


class StepBaseline:
    """The dissertation's baseline: the mean return of all episodes of the instance, its own too, at the same time."""

    def __init__(self, *, discount: float, episodes: int) -> None:
        self._discount, self._episodes = discount, episodes

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages; there is no critic."""
        advantages = step_baseline_advantages(
            rollout.rewards,
            rollout.elapsed,
            rollout.times[:-1],
            rollout.valid[:-1],
            discount=self._discount,
            length=rollout.length,
            episodes=self._episodes,
        )
        return Estimate(advantages, None, 0.0, rollout.valid[:-1])

    def state(self) -> dict[str, float | None]:
        """Nothing."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""


def explained_variance(targets: Tensor, values: Tensor, loss_mask: Tensor) -> float:
    """Share of the variance of value targets that values explain, over the turns of `loss_mask`; all (T, B).

    0 where no turn is in it, of which there is nothing to explain.
    """
    if not loss_mask.any():
        return 0.0
    residual = (targets - values)[loss_mask].var(correction=0)
    return float(1 - residual / targets[loss_mask].var(correction=0).clamp(min=1e-12))


@torch.inference_mode()
def values_of(critic: nn.Module, rollout: Rollout) -> Tensor:
    """A critic's values (T + 1, B) of a rollout's states, a few turns at a time to keep memory small.

    The critic is asked on its own device, its values come back to the rollout's, the CPU.
    """
    values, device = [], device_of(critic)
    for start in range(0, rollout.times.shape[0], 8):
        part = {name: v[start : start + 8].flatten(0, 1).to(device) for name, v in rollout.central.items()}
        values.append(critic(part).unflatten(0, (-1, rollout.times.shape[1])))
    return torch.cat(values).cpu()

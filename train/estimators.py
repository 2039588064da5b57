"""Advantage estimators as parts of a run: each turns a rollout into advantages and, with a critic, value targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from marl_sched.train.advantages import generalised_advantages, step_baseline_advantages
from marl_sched.train.collect import Rollout

_RATE_STEP = 0.2  # of the exponential average of the reward rate


@dataclass(frozen=True)
class Estimate:
    """Advantages (T, B), value targets (T, B) or None, and how much of the targets' variance the critic explains."""

    advantages: Tensor
    value_targets: Tensor | None
    explained_variance: float


class Estimator(Protocol):
    """What the training loop asks for."""

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages of a rollout's turns, zero where a turn is not valid."""

    def state(self) -> dict[str, float | None]:
        """What a resumed run needs, as JSON."""

    def restore(self, state: dict[str, float | None]) -> None:
        """Go on from a saved state."""


class CriticEstimator:
    """Generalised advantages from a critic that is given the full graph.

    The average reward rate is subtracted from rewards ("reward centring"; Naik et al. 2024), so that values
    say how much better than usual a state is, a few units, and not what a hundred hours are worth. In a
    problem whose episodes end by themselves that would change what is best; there `centred` must be False.
    """

    def __init__(self, critic: nn.Module, *, discount: float, trace: float, centred: bool) -> None:
        self._critic, self._discount, self._trace, self._centred = critic, discount, trace, centred
        self._rate: float | None = None

    def estimate(self, rollout: Rollout) -> Estimate:
        """Advantages and value targets."""
        rate = 0.0
        if self._centred:
            seen = rollout.reward_rate
            rate = seen if self._rate is None else self._rate + _RATE_STEP * (seen - self._rate)
            self._rate = rate
        values = self._values(rollout)
        advantages, targets = generalised_advantages(
            rollout.rewards - rate * rollout.elapsed,
            rollout.elapsed,
            values,
            rollout.valid,
            rollout.alive,
            discount=self._discount,
            trace=self._trace,
        )
        valid = rollout.valid[:-1]
        residual = (targets - values[:-1])[valid].var(correction=0)
        variance = targets[valid].var(correction=0)
        return Estimate(advantages, targets, float(1 - residual / variance.clamp(min=1e-12)))

    @torch.inference_mode()
    def _values(self, rollout: Rollout) -> Tensor:
        """Values (T + 1, B), a few turns at a time to keep memory small."""
        turns = rollout.times.shape[0]
        values = []
        for start in range(0, turns, 8):
            part = {name: v[start : start + 8].flatten(0, 1) for name, v in rollout.central.items()}
            values.append(self._critic(part).unflatten(0, (-1, rollout.times.shape[1])))
        return torch.cat(values)

    def state(self) -> dict[str, float | None]:
        """The reward rate."""
        return {"reward_rate": self._rate}

    def restore(self, state: dict[str, float | None]) -> None:
        """The reward rate."""
        self._rate = state["reward_rate"]


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
        return Estimate(advantages, None, 0.0)

    def state(self) -> dict[str, float | None]:
        """Nothing."""
        return {}

    def restore(self, state: dict[str, float | None]) -> None:
        """Nothing."""

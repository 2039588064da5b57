"""What advantage estimators give and offer: each turns a rollout into advantages and, with a critic, value targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from marl_sched.train.collect import Rollout
from marl_sched.train.device import device_of


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

"""What advantage estimators give and offer: each turns a rollout into advantages and, with a critic, value targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from marl_sched.train.collect import Rollout
from marl_sched.train.device import device_of
from marl_sched.train.environment import CENTRAL

TIME_LEFT = "time_left"  # what a critic may be told beside the graph, float32, in the domain's unit
_PART = 1024  # states that a critic is asked about at once


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


@torch.no_grad()
def values_of(critic: nn.Module, rollout: Rollout) -> tuple[Tensor, Tensor]:
    """A critic's values of the states in which turns were taken and of those that they led to, float32 (T, B) each.

    The critic is asked on its own device, a part of the rows at a time to keep memory small; its values come back to
    the rollout's, the CPU. Where a turn is followed by another one of the same episode, the state that it led to is
    that turn's; of the others only those with a future are asked about, the rest get 0.
    """
    values = _in_parts(critic, seen_by_critic(rollout.data).flatten(0, 1)).view(rollout.data.shape).T
    following = torch.cat([values[1:], torch.zeros_like(values[:1])])
    needed = rollout.boundary & ~rollout.terminated & rollout.valid
    turn, row = needed.nonzero(as_tuple=True)
    following = torch.where(rollout.boundary, 0.0, following)
    if len(turn):
        following[turn, row] = _in_parts(critic, seen_by_critic(rollout.data["next"])[row, turn])
    return values, following


def seen_by_critic(states: TensorDictBase) -> TensorDictBase:
    """What a critic is shown of states: the central graph where it was recorded, else what the acting agent sees."""
    central = states.get(CENTRAL, None)
    return states if central is None else central


def _in_parts(critic: nn.Module, states: TensorDictBase) -> Tensor:
    device = device_of(critic)
    return torch.cat([critic(part.to(device)).cpu() for part in states.split(_PART)])

"""TorchRL's specification of an action that the acting agent may take now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torchrl.data import Categorical
from torchrl.data.utils import ACTION_SPACE_MAP

from marl_sched.envs.api.sampling import random_legal


@dataclass
class CurrentMask:
    """Which actions are legal now, where an environment and its specs find it.

    An object of its own, so that a copy or a pickle of an environment and its specs keeps it in common.
    """

    legal: np.ndarray  # bool (B, n_actions), written in place


class LegalActions(Categorical):
    """As `torchrl.data.Categorical`, of what a shared mask allows at the time of the draw.

    TorchRL's environments keep clones of their specs, a transformed one for instance. A clone of Categorical has a
    mask of its own, which nobody renews. A clone of this one looks at the same mask. `update_mask` gives a spec its
    own, as for the transform ActionMask.

    Args:
        current: the shared mask.
        n, shape, device, dtype, mask: as for Categorical.
    """

    def __init__(
        self,
        n: int,
        shape: torch.Size | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.int64,
        mask: torch.Tensor | None = None,
        *,
        current: CurrentMask | None = None,
    ) -> None:
        self._current = current
        self._own: torch.Tensor | None = None
        super().__init__(n, shape, device, dtype, mask)

    @property
    def mask(self) -> torch.Tensor | None:
        """Bool (B, n), or None: everything is legal."""
        if self._own is not None or self._current is None:
            return self._own
        return torch.from_numpy(self._current.legal).to(self.device)

    @mask.setter
    def mask(self, own: torch.Tensor | None) -> None:
        self._own = own

    def rand(self, shape: torch.Size | None = None) -> torch.Tensor:
        """A legal action for each element, each as likely; follows `torch.manual_seed`.

        Compiled: the `torch.multinomial` of Categorical takes as long as a whole step of a simulator.
        """
        mask = self.mask
        if mask is None:
            return super().rand(shape)
        mask = mask.expand(*(shape or ()), *mask.shape)
        size = mask.shape[:-1]
        uniform = torch.rand(size, dtype=torch.float64).reshape(-1).numpy()
        legal = mask.reshape(-1, mask.shape[-1]).cpu().numpy()
        return torch.from_numpy(random_legal(legal, uniform)).reshape(size).to(self.device, self.dtype)

    def clone(self) -> LegalActions:
        """The same spec, with the shared mask in common and its own one, if any, copied."""
        return self._as(self.device, self.dtype)

    def to(self, dest: Any) -> LegalActions:
        """The same spec with another dtype or on another device."""
        if isinstance(dest, torch.dtype):
            return self._as(self.device, dest)
        return self if dest is None else self._as(torch.device(dest), self.dtype)

    def _as(self, device: torch.device, dtype: torch.dtype) -> LegalActions:
        own = None if self._own is None else self._own.clone()
        return type(self)(self.space.n, self.shape, device, dtype, own, current=self._current)


ACTION_SPACE_MAP[LegalActions] = "categorical"  # so that TorchRL's value actors know what it is

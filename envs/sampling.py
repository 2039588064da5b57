"""Random choices among legal targets, and the refusal of others, fast enough not to be what a benchmark measures."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def random_legal(mask: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """A legal target for each row, int64 (B,), each with the same probability.

    mask int8 (B, n_targets) with target 0 always legal; uniform float64 (B,) in [0, 1).
    """
    targets = np.zeros(mask.shape[0], np.int64)
    for b in range(mask.shape[0]):
        legal = 0
        for target in range(mask.shape[1]):
            legal += mask[b, target] != 0
        left = int(uniform[b] * legal)
        for target in range(mask.shape[1]):
            if mask[b, target] != 0:
                if left == 0:
                    targets[b] = target
                    break
                left -= 1
    return targets


@njit(cache=True)
def first_illegal(mask: np.ndarray, targets: np.ndarray, acting: np.ndarray) -> int:
    """The first row whose acting agent chose what its mask forbids or what is no target, -1 if there is none.

    mask int8 (B, n_targets), targets int64 (B,), acting int64 (B,): rows with a negative agent may hold anything.
    """
    for b in range(mask.shape[0]):
        if acting[b] >= 0 and not (0 <= targets[b] < mask.shape[1] and mask[b, targets[b]] != 0):
            return b
    return -1

"""Random choices among legal actions, and the refusal of others, fast enough not to be what a benchmark measures."""

from __future__ import annotations

import numpy as np

from marl_sched.kernels import kernel


@kernel
def random_legal(mask: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """A legal action for each row, int64 (B,), each with the same probability.

    mask int8 (B, n_actions) with action 0 always legal; uniform float64 (B,) in [0, 1).
    """
    actions = np.zeros(mask.shape[0], np.int64)
    for b in range(mask.shape[0]):
        legal = 0
        for action in range(mask.shape[1]):
            legal += mask[b, action] != 0
        left = int(uniform[b] * legal)
        for action in range(mask.shape[1]):
            if mask[b, action] != 0:
                if left == 0:
                    actions[b] = action
                    break
                left -= 1
    return actions


@kernel
def first_illegal(mask: np.ndarray, actions: np.ndarray, acting: np.ndarray) -> int:
    """The first row whose acting agent chose what its mask forbids or what is no action, -1 if there is none.

    mask int8 (B, n_actions), actions int64 (B,), acting int64 (B,): rows with a negative agent may hold anything.
    """
    for b in range(mask.shape[0]):
        if acting[b] >= 0 and not (0 <= actions[b] < mask.shape[1] and mask[b, actions[b]] != 0):
            return b
    return -1

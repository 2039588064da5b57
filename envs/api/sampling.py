"""Random choices among legal actions, and the refusal of others, fast enough not to be what a benchmark measures."""

from __future__ import annotations

import numpy as np

from marl_sched.kernels import kernel


@kernel
def idle_illegal(
    mask: np.ndarray, actions: np.ndarray, acting: np.ndarray, allowed: np.ndarray, illegal: np.ndarray
) -> int:
    """Write the actions to `allowed`, with 0 for what the mask forbids, and say in `illegal` where that happened.

    mask bool (B, n_actions), actions, acting and allowed int64 (B,), illegal bool (B,). Where the acting agent is
    negative the action may be anything and becomes 0. Returns the first row with an action outside [0, n_actions),
    -1 if there is none.
    """
    outside = -1
    for b in range(mask.shape[0]):
        allowed[b] = 0
        illegal[b] = False
        if acting[b] < 0:
            continue
        if not 0 <= actions[b] < mask.shape[1]:
            outside = b if outside < 0 else outside
        elif mask[b, actions[b]]:
            allowed[b] = actions[b]
        else:
            illegal[b] = True
    return outside


@kernel
def random_legal(mask: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """A legal action for each row, int64 (B,), each with the same probability; 0 where nothing is legal.

    mask bool (B, n_actions); uniform float64 (B,) in [0, 1).
    """
    actions = np.zeros(mask.shape[0], np.int64)
    for b in range(mask.shape[0]):
        legal = 0
        for action in range(mask.shape[1]):
            legal += mask[b, action]
        left = int(uniform[b] * legal)
        for action in range(mask.shape[1]):
            if mask[b, action]:
                if left == 0:
                    actions[b] = action
                    break
                left -= 1
    return actions

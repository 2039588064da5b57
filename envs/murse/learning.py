"""How long a human takes, round after round (dissertation, equation 5.1 and section 5.7.1).

A person's mean duration for a task after i repetitions is y = c + k exp(-beta i). A stochastic person draws
c, k and beta anew for every execution. A learning curve is six numbers, in the order of `CURVE`.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from marl_sched.kernels import kernel
from marl_sched.noise import FIRST_DOMAIN_STREAM, uniform

CURVE = ("c", "c_std", "k", "k_std", "beta", "beta_std")
C, C_STD, K, K_STD, BETA, BETA_STD = range(6)

NONE, ONE_SHOT, EXPONENTIAL = 0, 1, 2
LEARNING = ("none", "one_shot", "exponential")

DECREASE = (0.2, 0.4)  # of the mean duration between the first and the tenth round
ROUNDS_OF_DECREASE = 9
NOISE_STD = (1.0, 28.0)  # of c and k together


class MurseStream(IntEnum):
    """Streams of this domain's counter-based randomness."""

    DURATION = FIRST_DOMAIN_STREAM  # time = round, entity = (task, human), draws 0..3


@kernel(inline="always")
def remaining_share(beta: float, repetitions: int, learning: int) -> float:
    """The share of k that is still to be learnt away: exp(-beta i), or its limits for the two other modes."""
    if learning == NONE or repetitions == 0:
        return 1.0
    if learning == ONE_SHOT:
        return 0.0
    return np.exp(-beta * repetitions)


@kernel(inline="always")
def whole(duration: float, low: int, high: int) -> int:
    """A duration in whole time units, rounded down and clipped to the instance's range [low, high]."""
    return int(min(max(np.floor(duration), low), high))


@kernel
def mean_duration(curve: np.ndarray, repetitions: int, learning: int) -> float:
    """Equation 5.1 for one curve, float64 (6,)."""
    return curve[C] + curve[K] * remaining_share(curve[BETA], repetitions, learning)


@kernel
def normal_pair(time_word: np.uint64, entity: int, draw: int) -> tuple[float, float]:
    """Two standard normals from draws `draw` and `draw + 1` (Box and Muller, 1958)."""
    radius = np.sqrt(-2.0 * np.log(1.0 - uniform(time_word, MurseStream.DURATION, entity, draw)))
    angle = 2.0 * np.pi * uniform(time_word, MurseStream.DURATION, entity, draw + 1)
    return radius * np.cos(angle), radius * np.sin(angle)


@kernel
def drawn_duration(curve: np.ndarray, repetitions: int, learning: int, time_word: np.uint64, entity: int) -> float:
    """One execution's duration of a stochastic human, before rounding and clipping.

    c, k and beta are normal about their means; a negative beta, 0.15 percent of the draws, counts as 0.
    `time_word` is the noise of this round, `entity` names the pair of task and human.
    """
    first, second = normal_pair(time_word, entity, 0)
    third, _ = normal_pair(time_word, entity, 2)
    beta = max(curve[BETA] + curve[BETA_STD] * third, 0.0)
    c, k = curve[C] + curve[C_STD] * first, curve[K] + curve[K_STD] * second
    return c + k * remaining_share(beta, repetitions, learning)


def sample_curves(rng: np.random.Generator, n: int, start: tuple[float, float]) -> np.ndarray:
    """Curves of n pairs of human and task as in section 5.7.1, float64 (n, 6).

    The first round's mean c + k is uniform on `start`; c and k are at least 1; beta lets the mean fall by a
    share that is uniform on 20 to 40 percent until the tenth round. Of the ways to split the mean into c and k
    only those can be drawn in which k is large enough for that fall. The noise of c and k together is uniform
    on [1, 28], each at least 1, in quadrature; that of beta keeps 99.7 percent of the draws in [0, 2 beta].
    """
    mean = rng.uniform(*start, n)
    fall = rng.uniform(*DECREASE, n) * mean
    k = rng.uniform(np.maximum(1.05 * fall, 1.0), mean - 1.0)
    beta = -np.log(1.0 - fall / k) / ROUNDS_OF_DECREASE
    noise = np.maximum(rng.uniform(*NOISE_STD, n), np.sqrt(2.0))
    c_std = rng.uniform(1.0, np.sqrt(noise**2 - 1.0))
    k_std = np.sqrt(noise**2 - c_std**2)
    return np.stack([mean - k, c_std, k, k_std, beta, beta / 3.0], axis=1)

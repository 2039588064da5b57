"""What the team expects a human to take next: an adaptive Kalman filter per human and task (section 5.2.4).

The state is (c, k, log beta), hidden and static; the logarithm keeps beta positive. The prior is that of a
population of 50 generated humans (section 5.7.3). An observed duration y = c + k exp(-beta i) + noise is
linearised about the present mean (an extended filter). The noise of a person is unknown, differs by a factor
of twenty between people, and falls as k is learnt away. Its variance is estimated by innovation matching: each
squared innovation counts towards the noise by the noise's share of the innovation's variance, beside a prior
worth `PRIOR_WEIGHT` observations. As the variance is itself estimated, the interval for the next duration is
Student's with as many degrees of freedom as observations and prior have together.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from marl_sched.envs.murse.learning import BETA, C_STD, EXPONENTIAL, K_STD, C, K, remaining_share, sample_curves
from marl_sched.kernels import kernel

Record = Any  # one element of a record array, whose fields compiled code reads as attributes

POPULATION = 50
PRIOR_WEIGHT = 5.0
"""Chosen so that over many populations the 95 percent interval covers 94.5 to 95.6 percent at every repetition."""
LOG_BETA_RANGE = (-8.0, 1.0)
FLOOR = 0.5
"""Observed durations are rounded down: on average the time was half a unit longer."""

FILTER = np.dtype(
    [
        ("mean", np.float64, (3,)),  # c, k, log beta
        ("covariance", np.float64, (3, 3)),
        ("noise_sum", np.float64),  # sum of squares attributed to a first execution's noise, the prior's included
        ("k_noise_share", np.float64),  # of a first execution's noise variance; the rest is that of c
        ("updates", np.int64),
    ],
    align=True,
)


class Prior(NamedTuple):
    """What is known of a human of whom nothing is known."""

    mean: np.ndarray  # float64 (3,), of c, k, log beta
    covariance: np.ndarray  # float64 (3, 3)
    c_noise: float  # mean variance of c from execution to execution
    k_noise: float


def population_prior(rng: np.random.Generator, start: tuple[float, float]) -> Prior:
    """The prior of POPULATION humans generated with first-round means uniform on `start`."""
    curves = sample_curves(rng, POPULATION, start)
    states = np.stack([curves[:, C], curves[:, K], np.log(curves[:, BETA])], axis=1)
    noise = (curves[:, [C_STD, K_STD]] ** 2).mean(axis=0)
    return Prior(states.mean(axis=0), np.cov(states.T), float(noise[0]), float(noise[1]))


def new_filters(prior: Prior, shape: tuple[int, ...]) -> np.ndarray:
    """Filters, FILTER `shape`, that have seen nothing; the variance of Student's prior is the population's."""
    filters = np.zeros(shape, FILTER)
    filters["mean"], filters["covariance"] = prior.mean, prior.covariance
    noise = prior.c_noise + prior.k_noise
    filters["noise_sum"], filters["k_noise_share"] = (PRIOR_WEIGHT - 2.0) * noise, prior.k_noise / noise
    return filters


@kernel
def linearised(state: Record, repetitions: int, learning: int) -> tuple[float, tuple[float, float, float]]:
    """Expected duration and its derivatives by c, k and log beta: (float, (float, float, float))."""
    k, beta = state.mean[1], np.exp(state.mean[2])
    share = remaining_share(beta, repetitions, learning)
    slope = -k * beta * repetitions * share if learning == EXPONENTIAL else 0.0
    return state.mean[0] + k * share, (1.0, share, slope)


@kernel
def noise_ratio(state: Record, share: float) -> float:
    """The noise variance when `share` of k is left, relative to that of the first execution."""
    return 1.0 - state.k_noise_share * (1.0 - share**2)


@kernel
def noise_variance(state: Record, share: float) -> float:
    """The present estimate of one execution's variance about the curve when `share` of k is left."""
    return noise_ratio(state, share) * state.noise_sum / (PRIOR_WEIGHT + state.updates)


@kernel
def predict(state: Record, repetitions: int, learning: int) -> tuple[float, float]:
    """Mean and standard deviation (of curve and noise together) of the next duration before rounding and clipping."""
    expected, slopes = linearised(state, repetitions, learning)
    variance = noise_variance(state, slopes[1])
    for a in range(3):
        for b in range(3):
            variance += slopes[a] * state.covariance[a, b] * slopes[b]
    return expected, np.sqrt(variance)


@kernel
def update(state: Record, repetitions: int, learning: int, observed: float) -> None:
    """Take in one observed whole duration of a human who had repeated the task `repetitions` times."""
    expected, slopes = linearised(state, repetitions, learning)
    gain = np.zeros(3)
    for a in range(3):
        for b in range(3):
            gain[a] += state.covariance[a, b] * slopes[b]
    noise = noise_variance(state, slopes[1])
    total = noise + slopes[0] * gain[0] + slopes[1] * gain[1] + slopes[2] * gain[2]
    innovation = observed + FLOOR - expected
    for a in range(3):
        state.mean[a] += gain[a] * innovation / total
        for b in range(3):
            state.covariance[a, b] -= gain[a] * gain[b] / total
    state.mean[1] = max(state.mean[1], 0.0)
    state.mean[2] = min(max(state.mean[2], LOG_BETA_RANGE[0]), LOG_BETA_RANGE[1])
    state.noise_sum += innovation**2 * noise / total / noise_ratio(state, slopes[1])
    state.updates += 1


@kernel
def predict_each(filters: np.ndarray, repetitions: np.ndarray, learning: int) -> tuple[np.ndarray, np.ndarray]:
    """`predict` for each of FILTER (n,) after int64 (n,) repetitions: two float64 (n,)."""
    means, stds = np.empty(len(filters)), np.empty(len(filters))
    for j in range(len(filters)):
        means[j], stds[j] = predict(filters[j], repetitions[j], learning)
    return means, stds


@kernel
def update_each(filters: np.ndarray, repetitions: np.ndarray, learning: int, observed: np.ndarray) -> None:
    """`update` for each of FILTER (n,), int64 (n,) repetitions and float64 (n,) observed durations."""
    for j in range(len(filters)):
        update(filters[j], repetitions[j], learning, observed[j])


def interval(
    filters: np.ndarray, repetitions: np.ndarray, learning: int, limits: tuple[int, int], coverage: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """The whole durations, int64 (n,) lowest and highest, between which the next one lies with that probability.

    filters FILTER (n,), repetitions int64 (n,); `limits` is the range to which durations are clipped.
    """
    means, stds = predict_each(filters, repetitions, learning)
    from scipy.special import stdtrit  # Student's quantile; SciPy loads longer than all else that a simulator needs

    reach = stdtrit(PRIOR_WEIGHT + filters["updates"], 0.5 + coverage / 2.0) * stds
    low, high = np.floor(means - reach - FLOOR), np.ceil(means + reach - FLOOR)
    return np.clip(low, *limits).astype(np.int64), np.clip(high, *limits).astype(np.int64)

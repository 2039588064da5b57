"""The numbers that every table prints: mean, spread, interquartile mean with its interval, paired differences.

Scores come as float64 (I, E): E episodes of each of I problem instances. Schedulers are compared on the same
instances with the same noise, so entry (i, e) of two schedulers is a pair. The interquartile mean and its
stratified bootstrap follow Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (2021), with an instance as a stratum.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import stats

from marl_sched.errors import InvalidOptionError

CONFIDENCE = 0.95
_CHUNK = 2_000_000  # scores drawn at once: 16 MB


@dataclass(frozen=True)
class Summary:
    """One measure of one scheduler.

    Attributes:
        mean: over all instances and episodes.
        std: population standard deviation over instances of their episode means.
        iqm: mean of the middle half of all scores.
        ci95: 95 percent bootstrap interval of `iqm`.
    """

    mean: float
    std: float
    iqm: float
    ci95: tuple[float, float]

    def as_json(self) -> dict[str, Any]:
        """`{"mean", "std", "iqm", "ci95": [low, high]}`."""
        return {**asdict(self), "ci95": list(self.ci95)}


@dataclass(frozen=True)
class PairedDifference:
    """A scheduler's score less a baseline's on the same instances with the same noise.

    Attributes:
        mean: over instances of their mean differences.
        std: population standard deviation over instances.
        ci95: Student's 95 percent interval of the mean over instances; None with a single instance, whose
            difference says nothing about others.
    """

    mean: float
    std: float
    ci95: tuple[float, float] | None

    def as_json(self) -> dict[str, Any]:
        """`{"mean", "std", "ci95": [low, high] or null}`."""
        return {**asdict(self), "ci95": None if self.ci95 is None else list(self.ci95)}


def interquartile_mean(scores: np.ndarray) -> float:
    """The mean of what is left of all scores, float64 of any shape, without the lowest and the highest quarter.

    Of n scores floor(n / 4) are left out at either end.
    """
    return float(stats.trim_mean(scores, 0.25, axis=None))


def bootstrap_interval(scores: np.ndarray, rng: np.random.Generator, *, resamples: int = 2000) -> tuple[float, float]:
    """The 95 percent percentile interval of the interquartile mean of `scores`, float64 (I, E).

    Every resample draws E episodes with replacement within each instance: the interval is about these
    instances. With E = 1 an instance has nothing to draw from; then whole instances are drawn, and the
    interval is about the instances' population.
    """
    scores = _checked(scores)
    if resamples < 1:
        raise InvalidOptionError(f"resamples: expected an integer >= 1, got {resamples}")
    strata = scores if scores.shape[1] > 1 else scores.T
    rows = np.arange(strata.shape[0])[:, None]
    means = np.empty(resamples)
    chunk = max(1, _CHUNK // strata.size)
    for start in range(0, resamples, chunk):
        count = min(chunk, resamples - start)
        drawn = strata[rows, rng.integers(strata.shape[1], size=(count, *strata.shape))]
        means[start : start + count] = stats.trim_mean(drawn.reshape(count, -1), 0.25, axis=1)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def summarise(scores: np.ndarray, rng: np.random.Generator, *, resamples: int = 2000) -> Summary:
    """All statistics of one measure from `scores`, float64 (I, E).

    Raises InvalidOptionError if there is no score or one is not finite: an infeasible run has to be
    charged its worst case before it comes here, it is never dropped.
    """
    scores = _checked(scores)
    return Summary(
        mean=float(scores.mean()),
        std=float(scores.mean(axis=1).std()),
        iqm=interquartile_mean(scores),
        ci95=bootstrap_interval(scores, rng, resamples=resamples),
    )


def paired_difference(scores: np.ndarray, baseline: np.ndarray) -> PairedDifference:
    """`scores` less `baseline`, both float64 (I, E), per instance, with Student's interval over instances."""
    scores, baseline = _checked_pair(scores, baseline)
    differences = (scores - baseline).mean(axis=1)
    count, mean = len(differences), float(differences.mean())
    interval = None
    if count > 1:
        reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, count - 1) * stats.sem(differences))
        interval = (mean - reach, mean + reach)
    return PairedDifference(mean=mean, std=float(differences.std()), ci95=interval)


def percent_gain(scores: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """The gain over the baseline in percent of its instance mean, float64 (I, E): M2 of section 6.5.2.

    An instance's mean over episodes is 100 (mean score / mean baseline - 1). Where the baseline's mean is
    negative its size is the measure, so that a gain stays positive. Raises InvalidOptionError where it is 0.
    """
    scores, baseline = _checked_pair(scores, baseline)
    base = np.abs(baseline.mean(axis=1, keepdims=True))
    if not base.all():
        raise InvalidOptionError(f"no gain in percent over a baseline of 0 (instance {int(np.argmin(base))})")
    return 100.0 * (scores - baseline) / base


def _checked(scores: np.ndarray) -> np.ndarray:
    scores = np.asarray(scores, np.float64)
    if scores.ndim != 2 or scores.size == 0:
        raise InvalidOptionError(f"scores: expected shape (instances, episodes), got {scores.shape}")
    if not np.isfinite(scores).all():
        i, e = np.argwhere(~np.isfinite(scores))[0]
        raise InvalidOptionError(f"scores: instance {i}, episode {e}: expected a finite number, got {scores[i, e]}")
    return scores


def _checked_pair(scores: np.ndarray, baseline: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scores, baseline = _checked(scores), _checked(baseline)
    if scores.shape != baseline.shape:
        raise InvalidOptionError(f"baseline: expected the scores' shape {scores.shape}, got {baseline.shape}")
    return scores, baseline

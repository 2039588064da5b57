"""The numbers that every table prints: mean, spread, interquartile mean with two intervals, paired differences.

Scores come as float64 (I, E): E episodes of each of I problem instances. Schedulers are compared on the same
instances with the same noise, so entry (i, e) of two schedulers is a pair. The interquartile mean is that of Agarwal
et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021).

A 95 percent interval is of one of two kinds, and says which:

- `these_instances`: if the same instances were played again with other noise. It needs two episodes.
- `such_instances`: if other instances of the same kind were drawn and played. It needs two instances. As instances
  differ more than episodes do, it is the wider one, and the one to quote for a scheduler.

Both are Student intervals of the trimmed mean by its winsorised variance (Tukey and McLaughlin, 1963), within
instances for the first kind and between their means for the second. A percentile bootstrap of episodes, the usual
choice, covers 75 instead of 95 percent with two episodes; a test simulates what these cover.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import stdtr, stdtrit

from marl_sched.errors import InvalidOptionError

CONFIDENCE = 0.95
TRIMMED = 4  # a quarter of the scores is left out at either end

Interval = tuple[float, float]


@dataclass(frozen=True)
class Summary:
    """One measure of one scheduler.

    Attributes:
        mean: over all instances and episodes.
        std: population standard deviation over instances of their episode means; None for one instance.
        iqm: mean of the middle half of all scores.
        ci95_these_instances: 95 percent interval of `iqm` over the noise of these instances; None for one episode.
        ci95_such_instances: 95 percent interval of `iqm` over instances; None for one instance.
    """

    mean: float
    std: float | None
    iqm: float
    ci95_these_instances: Interval | None
    ci95_such_instances: Interval | None

    def as_json(self) -> dict[str, Any]:
        """The attributes by name, an interval as `[low, high]` or null."""
        return _as_json(self)


@dataclass(frozen=True)
class PairedDifference:
    """A scheduler's score less a baseline's on the same instances with the same noise.

    Attributes:
        mean: over instances of their mean differences.
        std: population standard deviation over instances; None for one instance.
        ci95_these_instances: Student's 95 percent interval of the mean over the noise of these instances; None for
            one episode.
        ci95_such_instances: Student's 95 percent interval of the mean over instances; None for one instance.
        p: two-sided probability of a difference at least as large if such instances had none on average; None for one
            instance. Where several differences are judged at once, see `holm`.
    """

    mean: float
    std: float | None
    ci95_these_instances: Interval | None
    ci95_such_instances: Interval | None
    p: float | None

    def as_json(self) -> dict[str, Any]:
        """The attributes by name, an interval as `[low, high]` or null."""
        return _as_json(self)


def _as_json(of: Summary | PairedDifference) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(of).items()}


def interquartile_mean(scores: np.ndarray) -> float:
    """The mean of what is left of all scores, float64 of any shape, without the lowest and the highest quarter.

    Of n scores floor(n / 4) are left out at either end.
    """
    ordered = np.sort(np.asarray(scores, np.float64), axis=None)
    out = len(ordered) // TRIMMED
    return float(ordered[out : len(ordered) - out].mean())


def summarise(scores: np.ndarray) -> Summary:
    """All statistics of one measure from `scores`, float64 (I, E).

    Raises InvalidOptionError if there is no score or one is not finite: an infeasible run has to be
    charged its worst case before it comes here, it is never dropped.
    """
    scores = _checked(scores)
    iqm = interquartile_mean(scores)
    ordered = np.sort(scores, axis=None)
    out = len(ordered) // TRIMMED
    kept = 1.0 - 2.0 * out / len(ordered)
    winsorised = np.clip(scores, ordered[out], ordered[-1 - out])
    return Summary(
        mean=float(scores.mean()),
        std=_std(scores.mean(axis=1)),
        iqm=iqm,
        ci95_these_instances=_within(iqm, winsorised, kept),
        ci95_such_instances=_between(iqm, winsorised.mean(axis=1), kept),
    )


def paired_difference(scores: np.ndarray, baseline: np.ndarray) -> PairedDifference:
    """`scores` less `baseline`, both float64 (I, E), episode by episode."""
    scores, baseline = _checked_pair(scores, baseline)
    pairs = scores - baseline
    differences = pairs.mean(axis=1)
    mean = float(differences.mean())
    return PairedDifference(
        mean=mean,
        std=_std(differences),
        ci95_these_instances=_within(mean, pairs, 1.0),
        ci95_such_instances=_between(mean, differences, 1.0),
        p=_p_value(differences),
    )


def holm(p: Sequence[float]) -> np.ndarray:
    """The p-values of several claims, each corrected for all of them being looked at (Holm, 1979), float64 (n,).

    If claims with a corrected value below 0.05 are made, the chance that any of them is false is at most 5 percent.
    """
    values = np.asarray(p, np.float64)
    order = np.argsort(values, kind="stable")
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1.0)
    return corrected


def _std(of_instances: np.ndarray) -> float | None:
    return float(of_instances.std()) if len(of_instances) > 1 else None


def _within(center: float, scores: np.ndarray, kept: float) -> Interval | None:
    """The interval over episodes of each instance, float64 (I, E), of a mean of the share `kept` of the scores."""
    instances, episodes = scores.shape
    if episodes == 1:
        return None
    error = float(np.sqrt(scores.var(axis=1, ddof=1).sum() / episodes)) / instances / kept
    return _student(center, error, max(1.0, kept * instances * (episodes - 1)))


def _between(center: float, of_instances: np.ndarray, kept: float) -> Interval | None:
    """The interval over instances, whose mean scores are float64 (I,)."""
    count = len(of_instances)
    if count == 1:
        return None
    error = float(of_instances.std(ddof=1)) / count**0.5 / kept
    return _student(center, error, max(1.0, kept * count - 1.0))


def _student(center: float, error: float, freedom: float) -> Interval:
    reach = float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * error
    return center - reach, center + reach


def _p_value(differences: np.ndarray) -> float | None:
    count, mean = len(differences), float(differences.mean())
    if count == 1:
        return None
    error = float(differences.std(ddof=1)) / count**0.5
    if error == 0.0:
        return 1.0 if mean == 0.0 else 0.0
    return 2.0 * float(stdtr(count - 1, -abs(mean) / error))


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

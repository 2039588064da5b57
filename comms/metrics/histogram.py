"""A histogram of constant memory, for latencies."""

from __future__ import annotations

import math

import numpy as np

LOWEST, GROWTH, BUCKETS = 1e-6, 1.02, 1000  # seconds, from 1 us to 400 s


class Histogram:
    """Counts values in buckets that grow by 2 percent each, so that quantiles are within 2 percent."""

    def __init__(self) -> None:
        self._counts = np.zeros(BUCKETS, np.int64)

    def add(self, value: float) -> None:
        """Count a value > 0, in seconds."""
        bucket = math.log(max(value, LOWEST) / LOWEST) / math.log(GROWTH)
        self._counts[min(int(bucket), BUCKETS - 1)] += 1

    def quantile(self, share: float) -> float | None:
        """The upper end of the bucket in which the quantile lies, None if nothing was counted."""
        total = int(self._counts.sum())
        if total == 0:
            return None
        bucket = int(np.searchsorted(np.cumsum(self._counts), max(math.ceil(share * total), 1)))
        return float(LOWEST * GROWTH ** (bucket + 1))

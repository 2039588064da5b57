"""A log that a flood cannot fill: one line per kind and second, with how many were held back."""

from __future__ import annotations

import logging
from collections import Counter

MAX_LINE = 300  # characters of what somebody else said


class ThrottledLog:
    """Writes warnings to a logger, at most one per kind and second."""

    def __init__(self, logger: logging.Logger, seconds: float = 1.0) -> None:
        self._logger, self._seconds = logger, seconds
        self._next: dict[str, float] = {}
        self._held_back: Counter[str] = Counter()

    def warn(self, kind: str, text: str, now: float) -> None:
        """Write a line now, or count it."""
        if now < self._next.get(kind, float("-inf")):
            self._held_back[kind] += 1
            return
        self._next[kind] = now + self._seconds
        more = self._held_back.pop(kind, 0)
        tail = f" (and {more} more of this kind)" if more else ""
        self._logger.warning("%s%s", text[:MAX_LINE], tail)

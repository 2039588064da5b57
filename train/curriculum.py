"""How long training episodes are: short ones first, as in the dissertation's algorithm 5."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marl_sched.errors import InvalidOptionError


@dataclass(frozen=True, kw_only=True)
class EpisodeLength:
    """Simulated time of an episode, an integer uniform on [T_min, T_min + spread].

    T_min is `start` in the first update and grows by `step` with each, to `stop` at most. The length is a
    function of (seed, update), so that a resumed run goes on with the same lengths.
    Raises InvalidOptionError if `stop` comes before `start`.
    """

    start: int
    step: float
    stop: int
    spread: int
    seed: int

    def __post_init__(self) -> None:
        """Refuse a curriculum that runs backwards."""
        if self.stop < self.start:
            raise InvalidOptionError(f"curriculum: stop: expected at least start ({self.start}), got {self.stop}")

    def __call__(self, update: int) -> int:
        """The length of the episodes that begin in this update; updates count from 0."""
        shortest = int(min(self.start + self.step * update, self.stop))
        return shortest + int(np.random.default_rng([self.seed, update]).integers(0, self.spread + 1))

    @property
    def longest(self) -> int:
        """No episode is longer."""
        return self.stop + self.spread

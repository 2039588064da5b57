"""What a crew sees of an AirME problem: everything, or its neighbourhood on the ring of crews.

Crews stand on a ring. The home sector of the plane in slot s is crew (s - 1) mod n_crews.

What a view lets a crew see in an episode comes down to three numbers, its limits: (reach, comm, staleness).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from marl_sched.envs.airme.state import EVERYWHERE
from marl_sched.envs.airme.streams import Stream
from marl_sched.errors import InvalidOptionError, require_integer
from marl_sched.kernels import kernel
from marl_sched.noise import integer, time_key, uniform

MOST_STALENESS = 8760  # hours: a year, of which a simulator keeps one snapshot an hour

Limits = tuple[int, int, int]  # reach, comm, staleness


@dataclass(frozen=True, kw_only=True)
class FullView:
    """Every crew sees every plane and every crew as they are, and all choices already made this hour."""

    kind = "full"
    hides = False

    @property
    def limits(self) -> Limits:
        """Those of all episodes."""
        return EVERYWHERE, EVERYWHERE, 0

    def limits_in(self, episode: np.uint64) -> Limits:
        """Those of the episode with that key of its noise."""
        return self.limits

    @property
    def memory(self) -> int:
        """How many hours back a delayed snapshot may be asked for."""
        return 0


@dataclass(frozen=True, kw_only=True)
class LocalView:
    """A crew sees sectors within ring distance `reach` and crews within `comm`.

    Its own sector it sees as it is; another one as it was `staleness` hours ago. Of a crew within `comm` it
    knows the present job and, if that crew has already acted this hour, its choice. What it learned from a conflict
    of a plane, and how it left a plane that it repaired itself, it keeps until the sector's delayed snapshot is newer.
    Raises InvalidOptionError for an option that is not an integer, negative or too large.
    """

    kind = "local"
    hides = True

    reach: int = 1
    comm: int = 1
    staleness: int = 0  # hours

    def __post_init__(self) -> None:
        """Bring the options to plain integers and refuse those outside their range."""
        for name, most in (("reach", EVERYWHERE), ("comm", EVERYWHERE), ("staleness", MOST_STALENESS)):
            object.__setattr__(self, name, require_integer(f"view local: {name}", getattr(self, name), 0, most))

    @property
    def limits(self) -> Limits:
        """Those of all episodes."""
        return self.reach, self.comm, self.staleness

    def limits_in(self, episode: np.uint64) -> Limits:
        """Those of the episode with that key of its noise."""
        return self.limits

    @property
    def memory(self) -> int:
        """How many hours back a delayed snapshot may be asked for."""
        return self.staleness


@dataclass(frozen=True, kw_only=True)
class RandomView:
    """In every episode another local view, so that one policy learns to serve them all.

    Reach and comm are integers uniform on [0, reach_most] and [0, comm_most]; a share `fresh_share` of the
    episodes has no staleness, in the others it is uniform on [0, staleness_most] hours. The numbers follow from the
    key of an episode's noise, so all schedulers that are compared meet the same views, a run that is resumed goes on
    with the same ones, and a deployed world tells its agents those of its episode.
    Raises InvalidOptionError for an option that is no number of its range.
    """

    kind = "random"
    hides = True

    reach_most: int = 3
    comm_most: int = 3
    staleness_most: int = 24  # hours
    fresh_share: float = 0.5

    def __post_init__(self) -> None:
        """Bring the options to plain numbers and refuse those outside their range."""
        bounds = {"reach_most": EVERYWHERE, "comm_most": EVERYWHERE, "staleness_most": MOST_STALENESS}
        for name, most in bounds.items():
            object.__setattr__(self, name, require_integer(f"view random: {name}", getattr(self, name), 0, most))
        fresh: Any = self.fresh_share  # whatever a caller gave
        if isinstance(fresh, bool) or not isinstance(fresh, int | float) or not 0.0 <= fresh <= 1.0:
            raise InvalidOptionError(f"view random: fresh_share: expected a share in [0, 1], got {fresh!r}")
        object.__setattr__(self, "fresh_share", float(fresh))

    def limits_in(self, episode: np.uint64) -> Limits:
        """Those of the episode with that key of its noise."""
        time_word = np.uint64(time_key(episode, 0))
        reach, comm, fresh, staleness = (uniform(time_word, int(Stream.VIEW), which, 0) for which in range(4))
        return (
            integer(reach, 0, self.reach_most),
            integer(comm, 0, self.comm_most),
            0 if fresh < self.fresh_share else integer(staleness, 0, self.staleness_most),
        )

    @property
    def memory(self) -> int:
        """How many hours back a delayed snapshot may be asked for."""
        return self.staleness_most


View = FullView | LocalView | RandomView
VIEWS: dict[str, type] = {"full": FullView, "local": LocalView, "random": RandomView}


@kernel(inline="always")
def home_sector(slot: int, n_crews: int) -> int:
    """The sector, a crew's index, to which the plane in a slot belongs."""
    return (slot - 1) % n_crews


@kernel(inline="always")
def ring_distance(a: int, b: int, n_crews: int) -> int:
    """Steps between two crews the shorter way round."""
    apart = abs(a - b)
    return min(apart, n_crews - apart)

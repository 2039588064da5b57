"""What a crew sees of an AirME problem: everything, or its neighbourhood on the ring of crews.

Crews stand on a ring. The home sector of the plane in slot s is crew (s - 1) mod n_crews.
"""

from __future__ import annotations

from dataclasses import dataclass

from numba import njit

from marl_sched.errors import require_integer

EVERYWHERE = 1 << 30
MOST_STALENESS = 8760  # hours: a year, of which a simulator keeps a picture an hour


@dataclass(frozen=True, kw_only=True)
class FullView:
    """Every crew sees every plane and every crew as they are, and all choices already made this hour."""

    kind = "full"

    @property
    def limits(self) -> tuple[int, int, int]:
        """(reach, comm, staleness) as the kernels take them."""
        return EVERYWHERE, EVERYWHERE, 0


@dataclass(frozen=True, kw_only=True)
class LocalView:
    """A crew sees sectors within ring distance `reach` and crews within `comm`.

    Its own sector it sees as it is; another one as it was `staleness` hours ago. Of a crew within `comm` it
    knows the present job and, if that crew has already acted this hour, its choice. What a conflict told it
    of a plane, and how it left a plane that it repaired itself, it keeps until the sector's picture is newer.
    Raises InvalidOptionError for an option that is not an integer, negative or too large.
    """

    kind = "local"

    reach: int = 1
    comm: int = 1
    staleness: int = 0  # hours

    def __post_init__(self) -> None:
        """Bring the options to plain integers and refuse those outside their range."""
        for name, most in (("reach", EVERYWHERE), ("comm", EVERYWHERE), ("staleness", MOST_STALENESS)):
            object.__setattr__(self, name, require_integer(f"view local: {name}", getattr(self, name), 0, most))

    @property
    def limits(self) -> tuple[int, int, int]:
        """(reach, comm, staleness) as the kernels take them."""
        return self.reach, self.comm, self.staleness


VIEWS: dict[str, type] = {"full": FullView, "local": LocalView}


@njit(cache=True, inline="always")
def home_sector(slot: int, n_crews: int) -> int:
    """The sector, a crew's index, to which the plane in a slot belongs."""
    return (slot - 1) % n_crews


@njit(cache=True, inline="always")
def ring_distance(a: int, b: int, n_crews: int) -> int:
    """Steps between two crews the shorter way round."""
    apart = abs(a - b)
    return min(apart, n_crews - apart)

"""What a nurse sees of the ward: everything, or the sections around her own."""

from __future__ import annotations

from dataclasses import dataclass

from marl_sched.errors import require_integer

EVERYWHERE = 1 << 30


@dataclass(frozen=True, kw_only=True)
class FullView:
    """Every nurse sees every patient, bed and nurse, and all choices already made in this quarter of an hour."""

    kind = "full"
    hides = False

    @property
    def limits(self) -> tuple[int, int]:
        """Reach and comm."""
        return EVERYWHERE, EVERYWHERE


@dataclass(frozen=True, kw_only=True)
class LocalView:
    """A nurse sees patients and beds of sections within `reach` of her own, and hears nurses within `comm`.

    What a nurse out of her hearing has chosen she does not know: she may choose the same patient, and then idles.
    Raises InvalidOptionError for an option that is not an integer, negative or too large.
    """

    kind = "local"
    hides = True

    reach: int = 1  # sections
    comm: int = 1  # sections

    def __post_init__(self) -> None:
        """Bring the options to plain integers and refuse those outside their range."""
        for name in ("reach", "comm"):
            value = require_integer(f"view local: {name}", getattr(self, name), 0, EVERYWHERE)
            object.__setattr__(self, name, value)

    @property
    def limits(self) -> tuple[int, int]:
        """Reach and comm."""
        return self.reach, self.comm


View = FullView | LocalView
VIEWS: dict[str, type] = {"full": FullView, "local": LocalView}

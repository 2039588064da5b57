"""Aircraft types and their failure models (dissertation, section 6.2.1, equation 6.1 and table 6.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from marl_sched.errors import InvalidOptionError

FailureModel = Literal["density", "hazard"]
HOURS_GRACE = 5  # parts that wear with hours cannot fail at or below this many operating hours


@dataclass(frozen=True, kw_only=True)
class AircraftType:
    """One type of aircraft: its failure model, how often it is used and what it may earn.

    Part 0 wears with landings, the others with operating hours divided by `hour_norm`.
    Raises InvalidOptionError for a value outside its domain.
    """

    name: str
    scales: tuple[float, ...]  # Weibull scale of each part
    shapes: tuple[float, ...]  # Weibull shape of each part
    hour_norm: float
    usage: float  # probability that a grounded, healthy plane starts a mission in an hour
    income: tuple[float, float]  # bounds of the uniform hourly income
    # What the parts are called, () for no names; neither the noise nor whether two types are the same depends on it.
    parts: tuple[str, ...] = field(default=(), repr=False, compare=False)

    def __post_init__(self) -> None:
        """Bring the numbers to plain floats, so that equal types hash alike, and refuse a type that cannot be."""
        for name in ("scales", "shapes", "income"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
        for name in ("hour_norm", "usage"):
            object.__setattr__(self, name, float(getattr(self, name)))
        where = f"aircraft type {self.name!r}"
        if not self.scales or len(self.scales) != len(self.shapes):
            raise InvalidOptionError(
                f"{where}: expected as many scales as shapes and at least one, "
                f"got {len(self.scales)} scales and {len(self.shapes)} shapes"
            )
        if self.parts and len(self.parts) != len(self.scales):
            raise InvalidOptionError(f"{where}: expected {len(self.scales)} names of parts, got {len(self.parts)}")
        if not all(0 < value < math.inf for value in (*self.scales, *self.shapes, self.hour_norm)):
            raise InvalidOptionError(f"{where}: scales, shapes and hour_norm must be finite and > 0")
        if not 0 <= self.usage <= 1:
            raise InvalidOptionError(f"{where}: usage must be a probability, got {self.usage}")
        if len(self.income) != 2 or not 0 < self.income[0] <= self.income[1] < math.inf:
            raise InvalidOptionError(f"{where}: income must be bounds 0 < low <= high, got {self.income}")


FIXED_WING = AircraftType(
    name="fixed_wing",
    scales=(15.0, 12.0, 18.0, 16.0),
    shapes=(5.0, 5.5, 6.0, 6.5),
    hour_norm=20.0,
    usage=0.6,
    income=(1.0, 20.0),
)
HELICOPTER = AircraftType(
    name="helicopter", scales=(8.0, 7.0, 5.0), shapes=(7.0, 6.0, 11.0), hour_norm=15.0, usage=0.3, income=(1.0, 10.0)
)
PUBLISHED_TYPES = (FIXED_WING, HELICOPTER)


def part_failure(kind: AircraftType, part: int, usage: np.ndarray, model: FailureModel = "density") -> np.ndarray:
    """Probability, float64 like `usage`, that a part fails in an hour flown at this usage.

    `usage` counts landings for part 0 and operating hours for the others. `density` takes the Weibull density
    of equation 6.1 as the hour's probability, as the published simulator does; `hazard` takes the Weibull
    hazard, capped at 1.
    """
    count = np.asarray(usage, np.float64)
    scale, shape = kind.scales[part], kind.shapes[part]
    ratio = count / scale if part == 0 else count / kind.hour_norm / scale
    # The hazard overflows where the survival is 0 long since, and at usage 0 for shapes below 1.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        hazard = shape / scale * ratio ** (shape - 1.0)
        survival = np.exp(-(ratio**shape))
        probability = np.where(survival > 0, hazard * survival, 0.0) if model == "density" else hazard
    grace = 0 if part == 0 else HOURS_GRACE
    return np.where(count > grace, np.minimum(probability, 1.0), 0.0)


def failure_table(types: Sequence[AircraftType], longest: int, model: FailureModel = "density") -> np.ndarray:
    """Failure probabilities float64 (n_types, n_parts, longest + 1), indexed by the integer usage counter.

    Types with fewer parts are padded with parts that never fail. `longest` must cover every counter that a
    run can reach; a density falls again past its mode but is never cut off.
    """
    if model not in ("density", "hazard"):
        raise InvalidOptionError(f"failure: expected 'density' or 'hazard', got {model!r}")
    parts = max(len(kind.scales) for kind in types)
    table = np.zeros((len(types), parts, longest + 1))
    usage = np.arange(longest + 1)
    for i, kind in enumerate(types):
        for part in range(len(kind.scales)):
            table[i, part] = part_failure(kind, part, usage, model)
    return table

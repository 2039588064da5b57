"""Tiny fleets whose noise is known beforehand, for tests of AirME.

A Weibull density of scale s and shape 2000 is 0 to machine precision at every integer but s, where it is
2000 / s / e > 1 for s < 735: such a part fails for certain at usage s. A scale of 1e9 never fails.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from marl_sched.envs.airme.aircraft import AircraftType
from marl_sched.envs.airme.instance import AirmeInstance
from marl_sched.envs.airme.simulator import AirmeSimulator

NEVER, CERTAIN = 1e9, 2000.0


def aircraft(
    name: str, *, usage: float, fails_at_landings: int | None = None, fails_at_hours: int | None = None
) -> AircraftType:
    """A type that flies with probability `usage` and fails at exactly the given counters, or never."""
    return AircraftType(
        name=name,
        scales=(float(fails_at_landings or NEVER), float(fails_at_hours or NEVER)),
        shapes=(CERTAIN if fails_at_landings else 2.0, CERTAIN if fails_at_hours else 2.0),
        hour_norm=1.0,
        usage=usage,
        income=(1.0, 20.0),
    )


STEADY = aircraft("steady", usage=1.0)
RESERVE = aircraft("reserve", usage=0.0)


def fleet(*planes: tuple[AircraftType, float, int, int, bool], n_crews: int = 1) -> AirmeInstance:
    """An instance from rows of (type, income, hours, landings, broken)."""
    types = tuple(dict.fromkeys(row[0] for row in planes))
    return AirmeInstance(
        n_crews=n_crews,
        kind=np.array([types.index(row[0]) for row in planes]),
        income=np.array([row[1] for row in planes]),
        hours=np.array([row[2] for row in planes]),
        landings=np.array([row[3] for row in planes]),
        broken=np.array([row[4] for row in planes]),
        types=types,
    )


def play(simulator: AirmeSimulator, *hours: Sequence[int]) -> None:
    """Play hours in row 0, each an action for every crew."""
    for choices in hours:
        simulator.play_hour(np.array([choices]))


def plane(simulator: AirmeSimulator, slot: int) -> dict[str, Any]:
    """Row 0's plane in a slot as a dict."""
    record = simulator.snapshot(0)["planes"][slot]
    return {name: record[name].item() for name in record.dtype.names}

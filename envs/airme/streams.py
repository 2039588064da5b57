"""What AirME draws, in the naming of marl_sched.noise."""

from __future__ import annotations

from enum import IntEnum

from marl_sched.noise import FIRST_DOMAIN_STREAM


class Stream(IntEnum):
    """Streams of AirME's noise; the entity is the plane's slot, for VIEW which of a view's numbers."""

    REPAIR_HOURS = FIRST_DOMAIN_STREAM
    REPAIR_COST = FIRST_DOMAIN_STREAM + 1
    MISSION = FIRST_DOMAIN_STREAM + 2
    MISSION_HOURS = FIRST_DOMAIN_STREAM + 3
    FAILURE = FIRST_DOMAIN_STREAM + 4  # draw = part
    VIEW = FIRST_DOMAIN_STREAM + 5  # at time 0

"""What AirME says on the wire: the payloads of its channels (marl_sched.envs.airme.telemetry), in msgpack."""

from __future__ import annotations

from functools import cache
from typing import Annotated, TypeVar

import msgspec

from marl_sched.errors import InvalidMessageError

Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Size = Annotated[int, msgspec.Meta(ge=1, lt=2**20)]
Hour = Annotated[int, msgspec.Meta(ge=0, lt=2**40)]

NOBODY, CHOSEN, REPAIRED = 0, 1, 2  # who has a plane in hand: nobody, a crew that chose it this hour, a repairer


class _Payload(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """A payload names its type and the type's version, so that a reader of another version refuses it."""


class Frame(_Payload, tag="airme.frame.1", frozen=True):
    """What every crew is told at the start: the sizes, the types' usage and the view."""

    n_planes: Size
    n_crews: Size
    max_planes: Size  # the padding
    max_crews: Size
    usage: Annotated[list[Annotated[float, msgspec.Meta(ge=0, le=1)]], msgspec.Meta(min_length=1)]
    reach: Count
    comm: Count
    staleness: Count  # hours


class PlaneStatus(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What there is to see of a plane; names and units as in dynamics.PLANE."""

    slot: Size
    kind: Count
    income: float
    hours: Count
    landings: Count
    broken: bool
    in_hand: Annotated[int, msgspec.Meta(ge=NOBODY, le=REPAIRED)]
    job_hours: Count
    job_cost: float
    job_done: Count
    mission_hours: Count
    mission_done: Count


class Sector(_Payload, tag="airme.sector.1", frozen=True):
    """A sector's planes as they were at the start of `hour`."""

    hour: Hour
    planes: list[PlaneStatus]


class CrewStatus(_Payload, tag="airme.crew.1", frozen=True):
    """A crew at a decision epoch of `hour`; see dynamics.CREW."""

    hour: Hour
    plane: Count
    job_hours: Count
    job_done: Count
    choice: Annotated[int, msgspec.Meta(ge=-1, lt=2**31)]


class KnownPlane(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A plane as a crew learnt it to be at `hour`."""

    hour: Hour
    plane: PlaneStatus


class Memory(_Payload, tag="airme.memory.1", frozen=True):
    """All that a crew learnt by itself and that is not older than the delayed snapshots of other sectors."""

    planes: list[KnownPlane]


P = TypeVar("P", bound=_Payload)
encode = msgspec.msgpack.Encoder().encode


def decode(payload: bytes, kind: type[P]) -> P:
    """The payload, or InvalidMessageError."""
    try:
        return _decoder(kind).decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessageError(f"not a message of type {kind.__struct_config__.tag}: {error}") from error


@cache
def _decoder(kind: type[P]) -> msgspec.msgpack.Decoder[P]:
    return msgspec.msgpack.Decoder(kind)


def sector_slots(sector: int, n_planes: int, n_crews: int) -> range:
    """The slots of the planes whose home a sector is."""
    return range(sector + 1, n_planes + 1, n_crews)

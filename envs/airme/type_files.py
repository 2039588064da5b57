"""Aircraft types with their parts as a file that people read and write.

    {"schema": 1, "types": [{"name": "turboprop", "usage": 0.5, "parts": [
        {"name": "landing gear", "wears_with": "landings", "scale": 15.0, "shape": 5.0},
        {"name": "engine", "wears_with": "hours", "scale": 240.0, "shape": 5.5}]}]}

A part's scale counts landings or operating hours divided by the type's `hour_norm`, as in table 6.1 of the
dissertation; without an `hour_norm` it is 1, so that scales count hours as records do.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from marl_sched.envs.airme.aircraft import AircraftType
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.files import read_json
from marl_sched.structs import convert

SCHEMA = 1
NO_LANDINGS_PART = (1e9, 20.0)  # scale and shape of a part that never fails, where no part wears with landings
UNKNOWN_INCOME = (1.0, 1.0)  # until a fleet says what its aircraft earn
USAGE = 0.5

_Positive = Annotated[float, Meta(gt=0, description="a number > 0")]
_Interval = list[float | None] | None


class _Part(Struct, forbid_unknown_fields=True):
    name: Annotated[str, Meta(min_length=1, description="a name")]
    wears_with: Annotated[Literal["landings", "hours"], Meta(description="'landings' or 'hours'")]
    scale: _Positive
    shape: _Positive
    # what `marl-sched fit` adds for the reader
    scale_interval: _Interval = None
    shape_interval: _Interval = None
    failures: int | None = None
    censored: int | None = None


class _Type(Struct, forbid_unknown_fields=True):
    name: Annotated[str, Meta(min_length=1, description="a name")]
    parts: Annotated[list[_Part], Meta(min_length=1, description="a list of parts that is not empty")]
    hour_norm: _Positive = 1.0
    usage: Annotated[float, Meta(ge=0, le=1, description="a probability in [0, 1]")] = USAGE
    income: Annotated[list[_Positive], Meta(min_length=2, max_length=2)] | None = None


class _File(Struct, forbid_unknown_fields=True):
    schema: Annotated[Literal[1], Meta(description="1")]
    types: Annotated[list[_Type], Meta(min_length=1, description="a list of types that is not empty")]
    intervals: str = ""  # what the parts' intervals are, for the reader


def read_types(path: str | Path) -> tuple[AircraftType, ...]:
    """The types of a file; InvalidFileError names the file and the field.

    Types without income have UNKNOWN_INCOME. The part that wears with landings becomes the first.
    """
    file = convert(read_json(path), _File, path)
    types = tuple(_as_type(kind, f"types[{i}]", path) for i, kind in enumerate(file.types))
    names = [kind.name for kind in types]
    if len(set(names)) != len(names):
        raise InvalidFileError(path, "types", "names that differ", names)
    return types


def _as_type(kind: _Type, place: str, path: str | Path) -> AircraftType:
    by_landings = [part for part in kind.parts if part.wears_with == "landings"]
    if len(by_landings) > 1:
        names = [part.name for part in by_landings]
        raise InvalidFileError(path, f"{place}.parts", "at most one part that wears with landings", names)
    ordered = by_landings + [part for part in kind.parts if part.wears_with == "hours"]
    scales, shapes, names = ([getattr(part, key) for part in ordered] for key in ("scale", "shape", "name"))
    if not by_landings:
        scales, shapes = [NO_LANDINGS_PART[0], *scales], [NO_LANDINGS_PART[1], *shapes]
        names = ["none that wears with landings", *names]
    try:
        return AircraftType(
            name=kind.name,
            scales=tuple(scales),
            shapes=tuple(shapes),
            hour_norm=kind.hour_norm,
            usage=kind.usage,
            income=UNKNOWN_INCOME if kind.income is None else (kind.income[0], kind.income[1]),
            parts=tuple(names),
        )
    except InvalidOptionError as error:
        raise InvalidFileError(path, place, f"a possible type ({error})") from error


def with_income_of(kind: AircraftType, incomes: list[float]) -> AircraftType:
    """The type with the bounds of these incomes, if it does not know its own."""
    if kind.income != UNKNOWN_INCOME or not incomes:
        return kind
    return replace(kind, income=(min(incomes), max(incomes)))


def as_data(types: tuple[AircraftType, ...]) -> dict[str, Any]:
    """The plain data of a file of types, from which `read_types` makes them again."""
    described = []
    for kind in types:
        names = kind.parts or tuple(f"part {k + 1}" for k in range(len(kind.scales)))
        parts = [
            {"name": name, "wears_with": "hours" if k else "landings", "scale": scale, "shape": shape}
            for k, (name, scale, shape) in enumerate(zip(names, kind.scales, kind.shapes, strict=True))
        ]
        described.append(
            {
                "name": kind.name,
                "hour_norm": kind.hour_norm,
                "usage": kind.usage,
                "income": list(kind.income),
                "parts": parts,
            }
        )
    return {"schema": SCHEMA, "types": described}

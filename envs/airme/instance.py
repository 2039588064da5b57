"""An AirME problem: a fleet and its maintenance crews at hour 0 (dissertation, sections 6.2 and 6.5.2)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.files import read_json, write_json
from marl_sched.structs import convert

SCHEMA = 2  # 1 had no names of planes and parts
MOST_INCOME = 1e9  # sums over a fleet stay finite
MOST = 1_000_000  # of hours and landings, which index failure tables: beyond this a file is wrong, not large
MOST_PLANES = 10_000  # and crews: an hour of such a fleet takes milliseconds, its observation megabytes


@dataclass(frozen=True, kw_only=True, eq=False)
class AirmeInstance:
    """A fleet and its maintenance crews at hour 0: all planes grounded, all crews free.

    Index p runs over planes. Raises InvalidOptionError if arrays differ in length, two types share a name, or a
    value cannot be.
    """

    n_crews: int
    kind: np.ndarray  # int32 (P,), index into `types`
    income: np.ndarray  # float64 (P,), per flying hour
    hours: np.ndarray  # int32 (P,), operating hours since the last repair
    landings: np.ndarray  # int32 (P,), landings since the last repair
    broken: np.ndarray  # bool (P,)
    types: tuple[AircraftType, ...] = PUBLISHED_TYPES
    names: tuple[str, ...] = ()  # what planes are called, such as their tail numbers; () for no names
    noise_of: int | None = None  # the identity of another fleet, whose noise this one is to meet; None: its own

    def __post_init__(self) -> None:
        """Bring the arrays to their dtypes, make them read-only, and check them."""
        for name, dtype in _ARRAYS.items():
            array: np.ndarray = np.array(getattr(self, name), dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        problem = self._problem()
        if problem:
            raise InvalidOptionError(f"AirME instance: {problem}")

    def _problem(self) -> str:
        for name, count in (("n_crews", self.n_crews), ("planes", self.n_planes)):
            if not 1 <= count <= MOST_PLANES:
                return f"{name}: expected 1 to {MOST_PLANES}, got {count}"
        names = [kind.name for kind in self.types]
        if len(set(names)) != len(names):
            return f"types: expected names that differ, got {names}"
        if self.names and (len(self.names) != self.n_planes or len(set(self.names)) != self.n_planes):
            return f"names: expected a name for each of {self.n_planes} planes, all different, got {len(self.names)}"
        for name in _ARRAYS:
            if getattr(self, name).shape != (self.n_planes,):
                return f"{name}: expected one value per plane ({self.n_planes}), got {getattr(self, name).shape}"
        for name, good, expected in (
            ("kind", (self.kind >= 0) & (self.kind < len(self.types)), f"an index into {len(self.types)} types"),
            ("income", (self.income > 0) & (self.income <= MOST_INCOME), _INCOME),
            ("hours", (self.hours >= 0) & (self.hours <= MOST), f"an integer in [0, {MOST}]"),
            ("landings", (self.landings >= 0) & (self.landings <= MOST), f"an integer in [0, {MOST}]"),
        ):
            if not good.all():
                p = int(np.flatnonzero(~good)[0])
                return f"planes[{p}].{name}: expected {expected}, got {getattr(self, name)[p]}"
        return ""

    @property
    def n_planes(self) -> int:
        """Number of planes, the null plane not counted."""
        return len(self.kind)

    def __repr__(self) -> str:
        """One line: sizes and identity."""
        return f"AirmeInstance({self.n_planes} planes, {self.n_crews} crews, {self.identity:016x})"

    @cached_property
    def identity(self) -> int:
        """A 64-bit hash of the content, names left out: the instance's name in counter-based randomness."""
        if self.noise_of is not None:
            return self.noise_of
        digest = blake2b(digest_size=8)
        digest.update(repr((self.n_crews, self.types)).encode())
        for name, dtype in _ARRAYS.items():
            digest.update(getattr(self, name).astype(np.dtype(dtype).newbyteorder("<")).tobytes())
        return int.from_bytes(digest.digest(), "little")

    def as_json(self) -> dict[str, Any]:
        """Plain data, one object per plane, from which `decode` makes the instance again."""
        planes = [
            {
                **({"name": self.names[p]} if self.names else {}),
                "type": self.types[self.kind[p]].name,
                "income": float(self.income[p]),
                "hours": int(self.hours[p]),
                "landings": int(self.landings[p]),
                "broken": bool(self.broken[p]),
            }
            for p in range(self.n_planes)
        ]
        types = [asdict(kind) for kind in self.types]
        for kind in types:
            if not kind["parts"]:
                del kind["parts"]
        return {"schema": SCHEMA, "env": "airme", "n_crews": self.n_crews, "types": types, "planes": planes}

    def save(self, path: str | Path) -> None:
        """Write `as_json` to a file, whole or not at all."""
        write_json(path, self.as_json())


_INCOME_BOUNDS = f"bounds 0 < low <= high <= {MOST_INCOME:.0e}"
_INCOME = f"a number in (0, {MOST_INCOME:.0e}] (per flying hour)"
_ARRAYS: dict[str, type] = {
    "kind": np.int32,
    "income": np.float64,
    "hours": np.int32,
    "landings": np.int32,
    "broken": np.bool_,
}


@dataclass(frozen=True)
class Scale:
    """Bounds, both ends included, of what the generator draws (section 6.5.2)."""

    fixed_wing: tuple[int, int]
    helicopters: tuple[int, int]
    crews: tuple[int, int]

    @property
    def max_planes(self) -> int:
        """Planes of the largest instance."""
        return self.fixed_wing[1] + self.helicopters[1]


SCALES = {
    "small": Scale((16, 24), (8, 12), (6, 8)),
    "medium": Scale((32, 48), (16, 24), (12, 16)),
    "large": Scale((64, 96), (32, 48), (24, 32)),
}


def generate(scale: str, rng: np.random.Generator, types: tuple[AircraftType, ...] = PUBLISHED_TYPES) -> AirmeInstance:
    """Draw an instance of a scale as the published generator does.

    Hours are uniform on [0, 120], landings follow from them, a plane is broken with probability 0.1, income is
    uniform within its type's bounds. The first of `types` takes the place of fixed-wing aircraft, the second
    that of helicopters. Raises UnknownNameError for a scale that is not one of SCALES.
    """
    if scale not in SCALES:
        raise UnknownNameError("scale of airme", scale, SCALES)
    if len(types) != 2:
        raise InvalidOptionError(f"types: the scales mix two aircraft types, got {len(types)}")
    bounds = SCALES[scale]
    counts = [int(rng.integers(low, high + 1)) for low, high in (bounds.fixed_wing, bounds.helicopters)]
    n_crews = int(rng.integers(bounds.crews[0], bounds.crews[1] + 1))
    kind = np.repeat(np.arange(2, dtype=np.int32), counts)
    low, high = np.array([types[k].income for k in kind]).T
    hours = rng.integers(0, 121, len(kind))
    landings = rng.integers(hours // 10, hours // 5 + 1) + rng.integers(-2, 3, len(kind))
    return AirmeInstance(
        n_crews=n_crews,
        kind=kind,
        income=rng.uniform(low, high),
        hours=hours,
        landings=np.maximum(landings, 0),
        broken=rng.random(len(kind)) < 0.1,
        types=types,
    )


class _Type(Struct, forbid_unknown_fields=True):
    """An aircraft type as a file has it."""

    name: Annotated[str, Meta(min_length=1, description="a name")]
    scales: Annotated[
        list[Annotated[float, Meta(gt=0)]], Meta(min_length=1, description="numbers > 0, one for each part")
    ]
    shapes: Annotated[list[Annotated[float, Meta(gt=0)]], Meta(description="numbers > 0, as many as scales")]
    hour_norm: Annotated[float, Meta(gt=0, description="a number > 0")]
    usage: Annotated[float, Meta(ge=0, le=1, description="a probability in [0, 1]")]
    income: Annotated[list[float], Meta(min_length=2, max_length=2, description=_INCOME_BOUNDS)]
    parts: Annotated[list[str], Meta(description="names, as many as scales")] = []


class _Plane(Struct, forbid_unknown_fields=True):
    """A plane as a file has it."""

    type: Annotated[str, Meta(description="an aircraft type's name")]
    income: Annotated[float, Meta(gt=0, le=MOST_INCOME, description=_INCOME)]
    hours: Annotated[int, Meta(ge=0, le=MOST, description=f"an integer in [0, {MOST}]")]
    landings: Annotated[int, Meta(ge=0, le=MOST, description=f"an integer in [0, {MOST}]")]
    broken: Annotated[bool, Meta(description="true or false")]
    name: Annotated[str, Meta(min_length=1, description="a name, such as a tail number")] | None = None


class _File(Struct, forbid_unknown_fields=True):
    """An instance as a file has it."""

    schema: Annotated[Literal[1, 2], Meta(description="1 or 2")]
    env: Annotated[Literal["airme"], Meta(description="'airme'")]
    n_crews: Annotated[int, Meta(ge=1, le=MOST_PLANES, description=f"an integer in [1, {MOST_PLANES}]")]
    types: Annotated[list[_Type], Meta(min_length=1, description="a list that is not empty")]
    planes: Annotated[
        list[_Plane], Meta(min_length=1, max_length=MOST_PLANES, description=f"a list of 1 to {MOST_PLANES} planes")
    ]


def load(path: str | Path) -> AirmeInstance:
    """Read an instance; InvalidFileError names the file, the field, what was expected and what was found."""
    return decode(read_json(path), path)


def decode(data: Any, where: str | Path) -> AirmeInstance:
    """The instance that `AirmeInstance.as_json` wrote; InvalidFileError names `where` and the field."""
    file = convert(data, _File, where)
    types = tuple(_as_type(kind, f"types[{i}]", where) for i, kind in enumerate(file.types))
    names = {kind.name: i for i, kind in enumerate(types)}
    if len(names) != len(types):
        raise InvalidFileError(where, "types", "names that differ", [kind.name for kind in types])
    for p, plane in enumerate(file.planes):
        if plane.type not in names:
            raise InvalidFileError(where, f"planes[{p}].type", f"one of {[*names]}", plane.type)
    called = [plane.name for plane in file.planes if plane.name is not None]
    if called and (len(called) != len(file.planes) or len(set(called)) != len(called)):
        raise InvalidFileError(where, "planes", "a name for every plane, all different, or for none", called)
    return AirmeInstance(
        n_crews=file.n_crews,
        types=types,
        names=tuple(called),
        kind=np.array([names[plane.type] for plane in file.planes]),
        income=np.array([plane.income for plane in file.planes]),
        hours=np.array([plane.hours for plane in file.planes]),
        landings=np.array([plane.landings for plane in file.planes]),
        broken=np.array([plane.broken for plane in file.planes]),
    )


def _as_type(kind: _Type, place: str, where: str | Path) -> AircraftType:
    """A type of the fleet; what one field alone cannot show is checked here."""
    if len(kind.shapes) != len(kind.scales):
        raise InvalidFileError(where, f"{place}.shapes", f"{len(kind.scales)} numbers > 0", kind.shapes)
    if kind.parts and len(kind.parts) != len(kind.scales):
        raise InvalidFileError(where, f"{place}.parts", f"{len(kind.scales)} names", kind.parts)
    low, high = kind.income
    if not 0 < low <= high <= MOST_INCOME:
        raise InvalidFileError(where, f"{place}.income", _INCOME_BOUNDS, kind.income)
    return AircraftType(
        name=kind.name,
        scales=tuple(kind.scales),
        shapes=tuple(kind.shapes),
        hour_norm=kind.hour_norm,
        usage=kind.usage,
        income=(low, high),
        parts=tuple(kind.parts),
    )

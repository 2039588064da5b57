"""An AirME problem: a fleet and its maintenance crews at hour 0 (dissertation, sections 6.2 and 6.5.2)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.files import read_json, write_json

SCHEMA = 1
MOST_INCOME = 1e9  # sums over a fleet stay finite
MOST = 1_000_000  # counters index failure tables and crews size arrays: beyond this a file is wrong, not large


@dataclass(frozen=True, kw_only=True, eq=False)
class AirmeInstance:
    """A fleet and its maintenance crews at hour 0: all planes grounded, all crews free.

    Index p runs over planes. Raises InvalidOptionError if arrays differ in length or a value cannot be.
    """

    n_crews: int
    kind: np.ndarray  # int32 (P,), index into `types`
    income: np.ndarray  # float64 (P,), per flying hour
    hours: np.ndarray  # int32 (P,), operating hours since the last repair
    landings: np.ndarray  # int32 (P,), landings since the last repair
    broken: np.ndarray  # bool (P,)
    types: tuple[AircraftType, ...] = PUBLISHED_TYPES

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
        if self.n_crews < 1:
            return f"n_crews: expected at least 1, got {self.n_crews}"
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
        return "" if self.n_planes else "planes: expected at least one"

    @property
    def n_planes(self) -> int:
        """Number of planes, the null plane not counted."""
        return len(self.kind)

    @cached_property
    def identity(self) -> int:
        """A 64-bit hash of the content: the instance's name in counter-based randomness."""
        digest = blake2b(digest_size=8)
        digest.update(repr((self.n_crews, self.types)).encode())
        for name, dtype in _ARRAYS.items():
            digest.update(getattr(self, name).astype(np.dtype(dtype).newbyteorder("<")).tobytes())
        return int.from_bytes(digest.digest(), "little")

    def save(self, path: str | Path) -> None:
        """Write as JSON, one object per plane."""
        planes = [
            {
                "type": self.types[self.kind[p]].name,
                "income": float(self.income[p]),
                "hours": int(self.hours[p]),
                "landings": int(self.landings[p]),
                "broken": bool(self.broken[p]),
            }
            for p in range(self.n_planes)
        ]
        types = [asdict(kind) for kind in self.types]
        write_json(path, {"schema": SCHEMA, "env": "airme", "n_crews": self.n_crews, "types": types, "planes": planes})


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


def load(path: str | Path) -> AirmeInstance:
    """Read an instance; InvalidFileError names the file, the field and what was expected."""
    data = read_json(path)
    reader = _Reader(Path(path))
    reader.check("", data, isinstance(data, dict), "an object")
    reader.check("schema", data.get("schema"), data.get("schema") == SCHEMA, f"{SCHEMA}")
    reader.check("env", data.get("env"), data.get("env") == "airme", "'airme'")
    crews = reader.take(data, "", "n_crews", _is_count, f"an integer in [1, {MOST}]")
    types = tuple(_read_type(reader, f"types[{i}]", row) for i, row in enumerate(reader.rows(data, "types")))
    names = {kind.name: i for i, kind in enumerate(types)}
    reader.check("types", [kind.name for kind in types], len(names) == len(types), "names that differ")
    columns: dict[str, list[Any]] = {name: [] for name in _ARRAYS}
    for p, row in enumerate(reader.rows(data, "planes")):
        where = f"planes[{p}]"
        name = reader.take(row, where, "type", lambda v: isinstance(v, str) and v in names, f"one of {[*names]}")
        columns["kind"].append(names[name])
        columns["income"].append(reader.take(row, where, "income", _is_income, _INCOME))
        columns["hours"].append(reader.take(row, where, "hours", _is_natural, f"an integer in [0, {MOST}]"))
        columns["landings"].append(reader.take(row, where, "landings", _is_natural, f"an integer in [0, {MOST}]"))
        columns["broken"].append(reader.take(row, where, "broken", lambda v: isinstance(v, bool), "true or false"))
    return AirmeInstance(n_crews=crews, types=types, **{name: np.array(rows) for name, rows in columns.items()})


class _Reader:
    """Checks fields of one file and names the file in every complaint."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def check(self, where: str, value: Any, good: bool, expected: str) -> None:
        if not good:
            raise InvalidFileError(self.path, where, expected, value)

    def take(self, row: Any, where: str, field: str, good: Callable[[Any], bool], expected: str) -> Any:
        place = f"{where}.{field}" if where else field
        if not isinstance(row, dict):
            raise InvalidFileError(self.path, where, "an object", row)
        if field not in row:
            raise InvalidFileError(self.path, place, f"{expected}; the field is missing")
        if not good(row[field]):
            raise InvalidFileError(self.path, place, expected, row[field])
        return row[field]

    def rows(self, data: dict[str, Any], field: str) -> list[Any]:
        rows = self.take(data, "", field, lambda v: isinstance(v, list) and len(v) > 0, "a list that is not empty")
        return list(rows)


def _read_type(reader: _Reader, where: str, row: Any) -> AircraftType:
    def numbers(field: str, expected: str, good: Callable[[list[float]], bool]) -> tuple[float, ...]:
        def fits(value: Any) -> bool:
            return isinstance(value, list) and all(map(_is_number, value)) and good(value)

        return tuple(reader.take(row, where, field, fits, expected))

    name = reader.take(row, where, "name", lambda v: isinstance(v, str) and v != "", "a name")
    scales = numbers("scales", "numbers > 0, one for each part", lambda v: len(v) > 0 and min(v) > 0)
    low, high = numbers("income", f"bounds 0 < low <= high <= {MOST_INCOME:.0e}", _are_incomes)
    return AircraftType(
        name=name,
        scales=scales,
        shapes=numbers("shapes", f"{len(scales)} numbers > 0", lambda v: len(v) == len(scales) and min(v) > 0),
        hour_norm=reader.take(row, where, "hour_norm", _is_positive, "a number > 0"),
        usage=reader.take(row, where, "usage", lambda v: _is_number(v) and 0 <= v <= 1, "a probability in [0, 1]"),
        income=(low, high),
    )


def _is_number(value: Any) -> bool:
    # The comparison is exact for JSON's unbounded integers, and false for NaN.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_income(value: Any) -> bool:
    return _is_positive(value) and value <= MOST_INCOME


def _are_incomes(values: list[float]) -> bool:
    return len(values) == 2 and 0 < values[0] <= values[1] <= MOST_INCOME


def _is_natural(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MOST


def _is_count(value: Any) -> bool:
    return _is_natural(value) and value >= 1

"""A problem: jobs that arrive over the days, couriers with homes on a line and days on which they are away."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct, json, to_builtins

from marl_sched.files import read_json, write_json
from marl_sched.structs import convert

Day = Annotated[int, Meta(ge=0, le=10_000, description="a day >= 0")]
Place = Annotated[int, Meta(ge=0, le=1_000, description="a place on the line, an integer in [0, 1000]")]


class Job(Struct, frozen=True, forbid_unknown_fields=True):
    """A job can be started from `arrival` on, until it is `cancelled`; it takes `work` days or one more."""

    arrival: Day
    work: Annotated[int, Meta(ge=1, le=100, description="days, an integer in [1, 100]")]
    place: Place
    cancelled: Day | None = None


class Courier(Struct, frozen=True, forbid_unknown_fields=True):
    """A courier lives at `home` and takes no job on the days of `away`, first and last."""

    home: Place
    away: tuple[Day, Day] | None = None


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    schema: Literal[1]
    jobs: Annotated[list[Job], Meta(min_length=1, description="at least one job")]
    couriers: Annotated[list[Courier], Meta(min_length=1, description="at least one courier")]


@dataclass(frozen=True)
class CouriersInstance:
    """Jobs and couriers, each in the order of their slots."""

    jobs: tuple[Job, ...]
    couriers: tuple[Courier, ...]

    def __repr__(self) -> str:
        """One line: sizes and identity."""
        return f"CouriersInstance({len(self.jobs)} jobs, {len(self.couriers)} couriers, {self.identity:016x})"

    @cached_property
    def identity(self) -> int:
        """A 64-bit hash of the content."""
        return int.from_bytes(blake2b(json.encode((self.jobs, self.couriers)), digest_size=8).digest(), "little")

    def as_json(self) -> dict[str, Any]:
        """Plain data, from which `decode` makes the instance again."""
        return {"schema": 1, "jobs": to_builtins(self.jobs), "couriers": to_builtins(self.couriers)}

    def save(self, path: Path) -> None:
        """Write `as_json` to a file."""
        write_json(path, self.as_json())


@dataclass(frozen=True)
class Scale:
    """How many jobs, and between how many couriers, both ends included."""

    jobs: int
    couriers: tuple[int, int]


SCALES = {"town": Scale(6, (2, 3)), "city": Scale(10, (3, 4))}
MAP = 8  # places


def generate(scale: str, rng: np.random.Generator) -> CouriersInstance:
    """Draw a problem in which one job is cancelled and one courier is away for two days."""
    bounds = SCALES[scale]
    arrivals = np.sort(rng.integers(0, 7, bounds.jobs))
    jobs = [Job(int(day), int(rng.integers(1, 4)), int(rng.integers(MAP))) for day in arrivals]
    dropped = int(rng.integers(bounds.jobs))
    jobs[dropped] = Job(**{**to_builtins(jobs[dropped]), "cancelled": jobs[dropped].arrival + 2})
    couriers = [
        Courier(int(rng.integers(MAP))) for _ in range(rng.integers(bounds.couriers[0], bounds.couriers[1] + 1))
    ]
    first = int(rng.integers(1, 4))
    couriers[-1] = Courier(couriers[-1].home, (first, first + 1))
    return CouriersInstance(tuple(jobs), tuple(couriers))


def decode(data: Any, where: str | Path) -> CouriersInstance:
    """The instance in plain data; InvalidFileError names `where` and the field."""
    file = convert(data, _File, where)
    return CouriersInstance(tuple(file.jobs), tuple(file.couriers))


def load(path: Path) -> CouriersInstance:
    """Read an instance."""
    return decode(read_json(path), path)

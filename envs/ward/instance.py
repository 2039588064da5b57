"""A delivery ward and the patients that will arrive: instances, their generator and their files.

Sections of the ward lie along a corridor, numbered from 0; two sections are as far apart as their numbers. Times are
quarters of an hour.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct, json, to_builtins

from marl_sched.errors import InvalidFileError, require
from marl_sched.files import read_json, write_json
from marl_sched.structs import convert

QUARTERS = 4  # of an hour
STAGES = ("early", "active", "birth", "recovery")
MOST = 1000  # patients, beds, nurses or sections of an instance

Section = Annotated[int, Meta(ge=0, lt=MOST, description=f"a section, an integer in [0, {MOST - 1}]")]


class Patient(Struct, frozen=True, forbid_unknown_fields=True):
    """A woman in labour, as she will arrive.

    `arrival` in quarters of an hour, `section` where she waits, `stage` of her labour on arrival, `first` whether it
    is her first birth, which takes longer, `high_risk` whether neglect counts twice.
    """

    arrival: Annotated[int, Meta(ge=0, le=1_000_000, description="a quarter of an hour, an integer in [0, 1000000]")]
    section: Section
    stage: Annotated[Literal["early", "active", "birth", "recovery"], Meta(description="a stage of labour")] = "early"
    first: Annotated[bool, Meta(description="true or false")] = False
    high_risk: Annotated[bool, Meta(description="true or false")] = False


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    """An instance as a file has it."""

    schema: Annotated[Literal[1], Meta(description="1")]
    env: Annotated[Literal["ward"], Meta(description="'ward'")]
    beds: Annotated[list[Section], Meta(min_length=1, max_length=MOST, description="the section of each bed")]
    nurses: Annotated[list[Section], Meta(min_length=1, max_length=MOST, description="the home section of each nurse")]
    patients: Annotated[list[Patient], Meta(min_length=1, max_length=MOST, description="a list of 1 to 1000 patients")]


@dataclass(frozen=True, kw_only=True)
class WardInstance:
    """A ward at time 0 and who will arrive.

    `beds` holds the section of each bed, `nurses` the home section of each nurse, `patients` who will come, in the
    order of their slots, which begin at 1.
    """

    beds: tuple[int, ...]
    nurses: tuple[int, ...]
    patients: tuple[Patient, ...]

    def __repr__(self) -> str:
        """One line: sizes and identity."""
        sizes = f"{len(self.patients)} patients, {len(self.beds)} beds, {len(self.nurses)} nurses"
        return f"WardInstance({sizes}, {self.identity:016x})"

    @cached_property
    def identity(self) -> int:
        """A 64-bit hash of the content."""
        content = json.encode((self.beds, self.nurses, self.patients))
        return int.from_bytes(blake2b(content, digest_size=8).digest(), "little")

    def as_json(self) -> dict[str, Any]:
        """Plain data, from which `decode` makes the instance again."""
        return {
            "schema": 1,
            "env": "ward",
            "beds": list(self.beds),
            "nurses": list(self.nurses),
            "patients": to_builtins(self.patients),
        }

    def save(self, path: Path) -> None:
        """Write `as_json` to a file, whole or not at all."""
        write_json(path, self.as_json())


@dataclass(frozen=True)
class Scale:
    """How large instances are; nurses and patients are drawn between two bounds, both included."""

    sections: int
    beds: int  # of each section
    nurses: tuple[int, int]
    patients: tuple[int, int]


SCALES = {
    "small": Scale(6, 2, (6, 7), (26, 32)),
    "medium": Scale(12, 2, (12, 14), (52, 64)),
    "large": Scale(24, 2, (24, 28), (104, 128)),
}
DAY = 24 * QUARTERS  # patients of generated instances arrive within it
_THERE_AT_THE_START = 0.2
_STAGE_ON_ARRIVAL = (0.6, 0.35, 0.05)
_FIRST, _HIGH_RISK = 0.4, 0.25


def generate(scale: str, rng: np.random.Generator) -> WardInstance:
    """Draw an instance of a scale.

    Of the patients a fifth on average is there at time 0, the others arrive uniformly within 24 hours. Sections draw
    patients unevenly: their shares are Dirichlet(2, ..., 2). Six in ten arrive in early labour, 35 in a hundred in
    active labour; four in ten have their first birth; a quarter is at high risk. Nurse i's home is section i modulo
    the number of sections. Raises UnknownNameError for a scale that is not one of SCALES.
    """
    bounds = SCALES[require("scale of ward", scale, SCALES)]
    n_nurses = int(rng.integers(bounds.nurses[0], bounds.nurses[1] + 1))
    n_patients = int(rng.integers(bounds.patients[0], bounds.patients[1] + 1))
    shares = rng.dirichlet(np.full(bounds.sections, 2.0))
    arrivals = np.where(rng.random(n_patients) < _THERE_AT_THE_START, 0, rng.integers(0, DAY, n_patients))
    sections = rng.choice(bounds.sections, n_patients, p=shares)
    first, high_risk = rng.random(n_patients) < _FIRST, rng.random(n_patients) < _HIGH_RISK
    kinds = [STAGES[k] for k in rng.choice(len(_STAGE_ON_ARRIVAL), n_patients, p=_STAGE_ON_ARRIVAL)]
    patients = [
        Patient(int(arrivals[i]), int(sections[i]), kinds[i], bool(first[i]), bool(high_risk[i]))
        for i in np.argsort(arrivals, kind="stable")
    ]
    return WardInstance(
        beds=tuple(section for section in range(bounds.sections) for _ in range(bounds.beds)),
        nurses=tuple(i % bounds.sections for i in range(n_nurses)),
        patients=tuple(patients),
    )


def load(path: str | Path) -> WardInstance:
    """Read an instance; InvalidFileError names the file, the field, what was expected and what was found."""
    return decode(read_json(path), path)


def decode(data: Any, where: str | Path) -> WardInstance:
    """The instance that `WardInstance.as_json` wrote; InvalidFileError names `where` and the field."""
    file = convert(data, _File, where)
    sections = sorted(set(file.beds))
    for i, section in enumerate(file.nurses):
        if section not in sections:
            raise InvalidFileError(where, f"nurses[{i}]", f"a section that has a bed, one of {sections}", section)
    for i, patient in enumerate(file.patients):
        if patient.section not in sections:
            expected = f"a section that has a bed, one of {sections}"
            raise InvalidFileError(where, f"patients[{i}].section", expected, patient.section)
    return WardInstance(beds=tuple(file.beds), nurses=tuple(file.nurses), patients=tuple(file.patients))

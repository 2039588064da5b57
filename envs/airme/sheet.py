"""A fleet as a spreadsheet: an aircraft in every row."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType
from marl_sched.envs.airme.instance import MOST, MOST_INCOME, MOST_PLANES, AirmeInstance
from marl_sched.envs.airme.type_files import as_data, read_types, with_income_of
from marl_sched.sheets import Cell, Column, Complaints, Row, Setting, Sheet, number, one_of, text

READY, BROKEN = "ready", "broken"
_TYPES = "types"


def _types(settings: Mapping[str, Any]) -> dict[str, AircraftType]:
    """The published types and those of the file, by name; the file's go first."""
    own: Sequence[AircraftType] = settings[_TYPES] or ()
    return {kind.name: kind for kind in (*PUBLISHED_TYPES, *own)}


def _check(rows: Sequence[Row], settings: Mapping[str, Any], complaints: Complaints) -> None:
    """Note types that nobody describes, and a fleet that is too large."""
    known = _types(settings)
    for row in rows:
        if row["type"] is not None and row["type"] not in known:
            complaints.add(row.number, "type", f"one of {', '.join(known)}, or a type of a file --types", row["type"])
    if len(rows) > MOST_PLANES:
        complaints.add(None, "", f"at most {MOST_PLANES} aircraft", len(rows))


def _build(rows: Sequence[Row], settings: Mapping[str, Any]) -> AirmeInstance:
    """The fleet, with the types that fly in it."""
    flying = list(dict.fromkeys(row["type"] for row in rows))
    known = _types(settings)
    types = [with_income_of(known[name], [row["income"] for row in rows if row["type"] == name]) for name in flying]
    return AirmeInstance(
        n_crews=settings["crews"],
        types=tuple(types),
        names=tuple(row["tail"] for row in rows),
        kind=np.array([flying.index(row["type"]) for row in rows]),
        broken=np.array([row["state"] == BROKEN for row in rows]),
        income=np.array([row["income"] for row in rows]),
        hours=np.array([row["hours"] for row in rows]),
        landings=np.array([row["landings"] for row in rows]),
    )


def with_crews(fleet: AirmeInstance, crews: int) -> AirmeInstance:
    """The same fleet, meeting the same noise, with another number of crews."""
    return replace(fleet, n_crews=crews, noise_of=fleet.identity)


FLEET = Sheet(
    row="aircraft",
    key="tail",
    columns=(
        Column(name="tail", cell=text(), meaning="tail number or another name of the aircraft"),
        Column(name="type", cell=text(), meaning="fixed_wing, helicopter, or a type of the file given by --types"),
        Column(name="hours", cell=number(0, MOST, whole=True), meaning="operating hours since the last maintenance"),
        Column(name="landings", cell=number(0, MOST, whole=True), meaning="landings since the last maintenance"),
        Column(name="state", cell=one_of(READY, BROKEN), meaning="whether it can fly now"),
        Column(
            name="income",
            cell=number(0, MOST_INCOME, above=True),
            meaning="what an hour of flight earns, in units of half of what an hour of a crew costs",
        ),
    ),
    examples=(
        {"tail": "D-AIRA", "type": "fixed_wing", "hours": "52", "landings": "7", "state": READY, "income": "12.5"},
        {"tail": "D-AIRB", "type": "fixed_wing", "hours": "18", "landings": "2", "state": BROKEN, "income": "9"},
        {"tail": "D-HELI", "type": "helicopter", "hours": "31", "landings": "5", "state": READY, "income": "4.2"},
    ),
    settings=(
        Setting(
            name="crews",
            cell=number(1, MOST_PLANES, whole=True),
            meaning="number of maintenance crews",
            required=True,
            example="2",
            of=lambda fleet: fleet.n_crews,
            changes=with_crews,
        ),
        Setting(
            name=_TYPES,
            cell=Cell(expected="a file of aircraft types", read=read_types),
            meaning="file of aircraft types with their parts",
            template=lambda: json.dumps(as_data(PUBLISHED_TYPES), indent=2) + "\n",
        ),
    ),
    check=_check,
    build=_build,
)

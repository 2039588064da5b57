"""An hour of AirME in plain Python, written from the specification alone, to hold the compiled simulator against.

It shares no code with the simulator: its own SplitMix64 on Python integers, Weibull values from SciPy, dicts
for planes and crews. Slots count from 1; crews from 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from scipy.stats import weibull_min

from marl_sched.envs.airme.instance import AirmeInstance

_WORD = (1 << 64) - 1
_GAMMA = 0x9E3779B97F4A7C15
_REPAIR_HOURS, _REPAIR_COST, _MISSION, _MISSION_HOURS, _FAILURE = 16, 17, 18, 19, 20


def split_mix(x: int) -> int:
    """The finaliser of SplitMix64."""
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & _WORD
    return x ^ (x >> 31)


def absorb(key: int, value: int) -> int:
    """A key that depends on `key` and `value`."""
    return split_mix(((key ^ value) + _GAMMA) & _WORD)


@cache
def failure_probability(usage: int, scale: float, shape: float, norm: float, model: str) -> float:
    """One part's probability of failing in an hour at this usage, without the grace of new parts."""
    law = weibull_min(shape, scale=scale)
    density = float(law.pdf(usage / norm))
    if model == "hazard":
        return math.exp(min(0.0, float(law.logpdf(usage / norm) - law.logsf(usage / norm))))
    return min(1.0, density)


@dataclass
class World:
    """One instance in one episode."""

    instance: AirmeInstance
    seed: int
    episode: int = 0
    model: str = "density"
    time: int = 0
    planes: dict[int, dict[str, Any]] = field(default_factory=dict)
    crews: dict[int, dict[str, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        of = self.instance
        for p in range(of.n_planes):
            self.planes[p + 1] = {
                "type": of.types[of.kind[p]],
                "income": float(of.income[p]),
                "hours": int(of.hours[p]),
                "landings": int(of.landings[p]),
                "broken": bool(of.broken[p]),
                "crew": -1, "job_hours": 0, "job_done": 0, "job_cost": 0.0, "mission_hours": 0, "mission_done": 0,
            }  # fmt: skip
        self.crews = {c: {"plane": 0, "job_hours": 0, "job_done": 0} for c in range(of.n_crews)}
        # The order of this one sum is the instance's affair, not the hour's.
        self.total_income = float(of.income.sum())

    def uniform(self, stream: int, slot: int, draw: int = 0) -> float:
        """The uniform of this hour for a stream and a plane."""
        key = 0
        for value in (self.seed, self.instance.identity, self.episode, self.time):
            key = absorb(key, value)
        name = stream << 56 | draw << 40 | slot
        return (split_mix((key + (name + 1) * _GAMMA) & _WORD) >> 11) / 2.0**53

    def hour(self, decisions: Mapping[int, int]) -> tuple[float, float, float]:
        """Play an hour with at most one slot per crew; (profit, revenue, availability)."""
        for crew, slot in sorted(decisions.items()):
            self._send(crew, slot)
        for slot, plane in self.planes.items():
            self._start_mission(slot, plane)
        failed = [slot for slot, plane in self.planes.items() if plane["mission_hours"] and self._fails(slot, plane)]
        for slot in failed:
            self.planes[slot].update(broken=True, mission_hours=0, mission_done=0)
        for plane in self.planes.values():
            if plane["mission_hours"]:
                plane["hours"] += 1
                plane["mission_done"] += 1
            if plane["crew"] >= 0:
                plane["job_done"] += 1
                self.crews[plane["crew"]]["job_done"] += 1
        income = cost = 0.0
        for plane in self.planes.values():
            income += plane["income"] if plane["mission_hours"] else 0.0
            cost += plane["job_cost"] if plane["crew"] >= 0 else 0.0
        available = sum(1 for plane in self.planes.values() if not plane["broken"] and plane["crew"] < 0)
        for plane in self.planes.values():
            self._release(plane)
        self.time += 1
        return (income - cost) / self.total_income, income / self.total_income, available / len(self.planes)

    def _send(self, crew: int, slot: int) -> None:
        plane = self.planes.get(slot)
        if plane is None or plane["crew"] >= 0 or self.crews[crew]["plane"]:
            return
        hours = 2 + int(7 * self.uniform(_REPAIR_HOURS, slot))
        hours += plane["hours"] // 24 + plane["landings"] // 6 + (12 if plane["broken"] else 0)
        cost = (0.1 + 0.9 * self.uniform(_REPAIR_COST, slot)) * plane["income"]
        cost += 48.0 if plane["broken"] else 0.0
        cost += 2.0 * hours
        plane.update(crew=crew, job_hours=hours, job_done=0, job_cost=cost / hours, mission_hours=0, mission_done=0)
        self.crews[crew].update(plane=slot, job_hours=hours, job_done=0)

    def _start_mission(self, slot: int, plane: dict[str, Any]) -> None:
        if plane["broken"] or plane["crew"] >= 0 or plane["mission_hours"]:
            return
        if self.uniform(_MISSION, slot) < plane["type"].usage:
            plane.update(mission_hours=5 + int(6 * self.uniform(_MISSION_HOURS, slot)), mission_done=0)

    def _fails(self, slot: int, plane: dict[str, Any]) -> bool:
        kind = plane["type"]
        for part, (scale, shape) in enumerate(zip(kind.scales, kind.shapes, strict=True)):
            usage, norm, grace = (plane["landings"], 1.0, 0) if part == 0 else (plane["hours"], kind.hour_norm, 5)
            if usage <= grace:
                continue
            if self.uniform(_FAILURE, slot, part) < failure_probability(usage, scale, shape, norm, self.model):
                return True
        return False

    def _release(self, plane: dict[str, Any]) -> None:
        if plane["crew"] >= 0 and plane["job_done"] == plane["job_hours"]:
            self.crews[plane["crew"]].update(plane=0, job_hours=0, job_done=0)
            plane.update(crew=-1, job_hours=0, job_done=0, job_cost=0.0, hours=0, landings=0, broken=False)
        elif plane["mission_hours"] and plane["mission_done"] == plane["mission_hours"]:
            plane.update(landings=plane["landings"] + 1, mission_hours=0, mission_done=0)

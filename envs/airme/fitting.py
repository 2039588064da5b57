"""Weibull parameters of parts from failure records with censoring, by maximum likelihood.

A part's usage at failure is Weibull(scale, shape). A record is a failure at a known usage, one between two inspections
(interval-censored), or a part that had not failed when it was last seen (right-censored). Estimates come from
`scipy.stats.weibull_min.fit` on `CensoredData`; intervals are those of the profile likelihood: all values of a
parameter at which, with the other one chosen best, the log-likelihood is less than half of the chi-square quantile
below its maximum (Meeker, Escobar and Pascual, "Statistical methods for reliability data", 2022, chapter 8).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import CensoredData, chi2, weibull_min

from marl_sched.envs.airme.type_files import SCHEMA, USAGE
from marl_sched.sheets import Column, Complaints, Row, Setting, Sheet, number, one_of, text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVEL = 0.95
HOURS, LANDINGS = "hours", "landings"
FAILED, RUNNING = "failed", "running"
_FARTHEST = 7.0  # of an end of an interval from the estimate, in logarithms: beyond a thousandfold it is open
_WORDS = f"{100 * LEVEL:.0f} percent, of the profile likelihood"


@dataclass(frozen=True)
class Records:
    """What is known of one part of one type, in landings or hours: float64 arrays."""

    failed: np.ndarray  # (F,), usage at failure
    running: np.ndarray  # (R,), usage without a failure
    between: np.ndarray  # (I, 2), usage at the last inspection without the failure and at the first with it

    @property
    def failures(self) -> int:
        """Number of failures."""
        return len(self.failed) + len(self.between)

    def log_likelihood(self, log_scale: float, log_shape: float) -> float:
        """Of a Weibull distribution with these logarithms of its parameters."""
        shape = np.exp(log_shape)

        def cumulated(usage: np.ndarray) -> np.ndarray:
            return np.exp(np.clip(shape * (np.log(usage) - log_scale), -700.0, 700.0))

        with np.errstate(divide="ignore"):
            first, then = cumulated(self.between[:, 0]), cumulated(self.between[:, 1])
            within = -first + np.log(-np.expm1(first - then))
            densities = log_shape + (shape - 1) * np.log(self.failed) - shape * log_scale - cumulated(self.failed)
        return float(densities.sum() - cumulated(self.running).sum() + within.sum())


@dataclass(frozen=True, kw_only=True)
class PartFit:
    """A part's parameters and their intervals; an end that the records do not bound is None."""

    kind: str
    part: str
    wears_with: str
    records: Records
    scale: float
    shape: float
    scale_interval: tuple[float | None, float | None]
    shape_interval: tuple[float | None, float | None]


def fit_weibull(records: Records) -> tuple[float, float]:
    """Scale and shape of greatest likelihood."""
    data = CensoredData(uncensored=records.failed, right=records.running, interval=records.between)
    shape, _, scale = weibull_min.fit(data, floc=0)
    return float(scale), float(shape)


def profile_intervals(
    records: Records, scale: float, shape: float, level: float = LEVEL
) -> tuple[tuple[float | None, float | None], tuple[float | None, float | None]]:
    """The intervals of scale and shape around the estimates."""
    at = (float(np.log(scale)), float(np.log(shape)))
    least = records.log_likelihood(*at) - chi2.ppf(level, 1) / 2

    def of_scale(log_scale: float) -> float:
        return _best(lambda log_shape: records.log_likelihood(log_scale, log_shape), at[1]) - least

    def of_shape(log_shape: float) -> float:
        return _best(lambda log_scale: records.log_likelihood(log_scale, log_shape), at[0]) - least

    return _ends(of_scale, at[0]), _ends(of_shape, at[1])


def _best(value: Callable[[float], float], near: float) -> float:
    found = minimize_scalar(lambda x: -value(x), bracket=(near - 0.2, near + 0.2))
    return -float(found.fun)


def _ends(excess: Callable[[float], float], best: float) -> tuple[float | None, float | None]:
    """Where the excess, positive at `best`, becomes 0 below and above; None if it does not within _FARTHEST."""
    ends: list[float | None] = []
    for way in (-1.0, 1.0):
        near, width = best, 0.05
        while width < _FARTHEST and excess(best + way * width) > 0:
            near, width = best + way * width, 2 * width
        far = best + way * width
        ends.append(None if width >= _FARTHEST else float(np.exp(brentq(excess, *sorted((near, far)), xtol=1e-6))))
    return ends[0], ends[1]


@dataclass(frozen=True)
class Fit:
    """Fitted parts of one or more types."""

    parts: tuple[PartFit, ...]
    landing_hours: float

    def as_json(self) -> dict[str, Any]:
        """The plain data of a file of types (marl_sched.envs.airme.type_files) with intervals for the reader."""
        types: dict[str, dict[str, Any]] = {}
        for part in self.parts:
            described = types.setdefault(
                part.kind, {"name": part.kind, "hour_norm": 1.0, "usage": USAGE, "income": None, "parts": []}
            )
            longer = self._longer(part)
            described["parts"].append(
                {
                    "name": part.part,
                    "wears_with": part.wears_with,
                    "scale": longer * part.scale,
                    "shape": part.shape,
                    "scale_interval": [None if end is None else longer * end for end in part.scale_interval],
                    "shape_interval": list(part.shape_interval),
                    "failures": part.records.failures,
                    "censored": len(part.records.running),
                }
            )
        return {"schema": SCHEMA, "intervals": _WORDS, "types": list(types.values())}

    def _longer(self, part: PartFit) -> float:
        """What to multiply the scale by, so that a landing's hazard is spread over its mission's flying hours."""
        return float(self.landing_hours ** (1 / part.shape)) if part.wears_with == LANDINGS else 1.0

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Headings and rows of what was found in the records, for people."""
        headings = ["type", "part", "usage in", "failures", "running", "scale", "95 %", "shape", "95 %"]
        rows = [
            [
                one.kind, one.part, one.wears_with, str(one.records.failures), str(len(one.records.running)),
                f"{one.scale:.4g}", _interval(one.scale_interval), f"{one.shape:.3g}", _interval(one.shape_interval),
            ]
            for one in self.parts
        ]  # fmt: skip
        return headings, rows

    @property
    def remark(self) -> str:
        """What the parameters mean where they go."""
        return (
            f"intervals: {_WORDS}. In the simulator a plane fails in an hour with the Weibull density at its usage, as "
            "published; only with --failure hazard do parts that wear with hours fail as in the records."
        )

    def figure(self) -> Figure:
        """The picture: marl_sched.envs.airme.fit_figure."""
        from marl_sched.envs.airme.fit_figure import draw_fit

        return draw_fit(self)


def _interval(ends: tuple[float | None, float | None]) -> str:
    return ", ".join("open" if end is None else f"{end:.4g}" for end in ends)


def _check(rows: Sequence[Row], settings: Mapping[str, Any], complaints: Complaints) -> None:
    """Note parts with too few failures, two ways to count usage, or inspections in the wrong order."""
    units: dict[tuple[str, str], tuple[str, int]] = {}
    for row in rows:
        if None in (row["part"], row["wears with"], row["usage"], row["state"]):
            continue
        unit, first = units.setdefault((row["type"] or "", row["part"]), (row["wears with"], row.number))
        if unit != row["wears with"]:
            complaints.add(row.number, "wears with", f"{unit}, as in row {first}", row["wears with"])
        if row["last running"] is not None and row["state"] != FAILED:
            complaints.add(row.number, "last running", "nothing, as the part has not failed", row["last running"])
        elif row["last running"] is not None and row["last running"] >= row["usage"]:
            complaints.add(row.number, "last running", f"less than the usage {row['usage']:g}", row["last running"])
    for (_, part), own in _by_part(rows).items():
        found = {row["usage"] for row in own if row["state"] == FAILED}
        if len(found) < 2:
            what = f"part {part}: failures at two different usages at least"
            complaints.add(own[0].number, "", what, f"{len(found)} in {len(own)} records")
    for kind in {key[0] for key in units}:
        landings = [part for (of, part), (counts, _) in units.items() if of == kind and counts == LANDINGS]
        if len(landings) > 1:
            complaints.add(None, "", f"at most one part of type {kind} that wears with landings", landings)


def _by_part(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if None not in (row["part"], row["wears with"], row["usage"], row["state"]):
            found.setdefault((row["type"] or "own", row["part"]), []).append(row)
    return found


def _build(rows: Sequence[Row], settings: Mapping[str, Any]) -> Fit:
    parts = []
    for (kind, part), own in _by_part(rows).items():
        records = Records(
            failed=np.array([r["usage"] for r in own if r["state"] == FAILED and r["last running"] is None], float),
            running=np.array([r["usage"] for r in own if r["state"] == RUNNING], float),
            between=np.array(
                [(r["last running"], r["usage"]) for r in own if r["last running"] is not None], float
            ).reshape(-1, 2),
        )
        scale, shape = fit_weibull(records)
        of_scale, of_shape = profile_intervals(records, scale, shape)
        parts.append(
            PartFit(
                kind=kind,
                part=part,
                wears_with=own[0]["wears with"],
                records=records,
                scale=scale,
                shape=shape,
                scale_interval=of_scale,
                shape_interval=of_shape,
            )
        )
    return Fit(tuple(parts), settings["landing-hours"])


RECORDS = Sheet(
    row="record",
    columns=(
        Column(name="type", cell=text(), meaning="aircraft type", optional=True),
        Column(name="part", cell=text(), meaning="name of the part"),
        Column(name="wears with", cell=one_of(LANDINGS, HOURS), meaning="what its usage counts"),
        Column(name="usage", cell=number(0, above=True), meaning="usage at failure, or when it was last seen running"),
        Column(name="state", cell=one_of(FAILED, RUNNING), meaning="whether it had failed at that usage"),
        Column(
            name="last running",
            cell=number(0, above=True),
            meaning="usage at the last inspection before, where a failure was found by inspection",
            optional=True,
        ),
    ),
    examples=(
        {"type": "turboprop", "part": "engine", "wears with": HOURS, "usage": "212.5", "state": FAILED},
        {"type": "turboprop", "part": "engine", "wears with": HOURS, "usage": "181", "state": FAILED,
         "last running": "150"},
        {"type": "turboprop", "part": "engine", "wears with": HOURS, "usage": "160", "state": RUNNING},
    ),
    settings=(
        Setting(
            name="landing-hours",
            cell=number(0, above=True),
            meaning="flying hours of a mission, over which the hazard of its landing is spread; 7.5 in the simulator",
            default="1",
        ),
    ),
    check=_check,
    build=_build,
)  # fmt: skip

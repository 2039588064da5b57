"""How a rule ranks planes: one compiled function, for observations and for the simulator's own records alike.

A rule serves the open plane with the highest rank above its `least`, ties to the lowest slot. A rank is a function
of the hour and of what a crew knows of one plane: its type, whether it is broken, its counters, its income and how
long its mission lasts yet. It does not depend on other planes or on who decides, so that under a view that hides
nothing the free crews of an hour take the planes in the order of one queue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from marl_sched.agents.airme.bound.plane import BROKEN, HOURS_CAP, LANDINGS_CAP
from marl_sched.agents.airme.thresholds import FIRST
from marl_sched.compiled import entry
from marl_sched.envs.airme.features import PLANE
from marl_sched.kernels import kernel

CORRECTIVE, CORRECTIVE_AS_PUBLISHED, CONDITION, PERIODIC, MODEL_BASED, PREVENTIVE_FIRST, INDEX = range(7)
_NAMES = ("hours", "landings", "income", "broken", "mission_hours", "mission_done")
HOURS, LANDINGS, _INCOME, _BROKEN, _MISSION, _DONE = map(PLANE.index, _NAMES)
_PER_HOUR, _PER_LANDING, _PER_INCOME, _, _PER_MISSION, _PER_DONE = map(PLANE.scale, _NAMES)
N_FEATURES = len(PLANE)  # of a plane, without the one-hot of its type


class IndexTables(NamedTuple):
    """Indices of K types at S hours, J incomes and 11 states (marl_sched.agents.airme.bound.index)."""

    values: np.ndarray  # float32 (K, J, S, 11, L + 1, H + 1)
    incomes: np.ndarray  # float64 (K, J)
    hours: np.ndarray  # int64 (S,)
    first: np.ndarray  # int64 (K, L + 1), least hours that can be reached with so many landings
    last: np.ndarray  # int64 (K, L + 1), most hours


class Ranking(NamedTuple):
    """A rule: which one, and its thresholds."""

    rule: int  # CORRECTIVE ... INDEX
    least: float  # planes are served whose rank is higher
    period: int  # hours; nothing is served between multiples of it
    hours: float  # operating hours from which a plane counts as worn
    landings: float  # likewise
    risk: float  # failure probability from which a plane is served
    tables: IndexTables


NO_TABLES = IndexTables(
    np.zeros((0, 0, 0, 0, 0, 0), np.float32),
    np.zeros((0, 0)),
    np.zeros(0, np.int64),
    np.zeros((0, 0), np.int64),
    np.zeros((0, 0), np.int64),
)


def ranking(
    rule: int,
    *,
    least: float = -np.inf,
    period: int = 1,
    hours: float = 0.0,
    landings: float = 0.0,
    risk: float = 0.0,
    tables: IndexTables = NO_TABLES,
) -> Ranking:
    """A ranking in which what the rule does not read has a value of the right type."""
    return Ranking(rule, float(least), int(period), float(hours), float(landings), float(risk), tables)


class Known(NamedTuple):
    """What a crew knows of one plane."""

    kind: int  # index of the type, -1: unknown
    broken: bool
    hours: int
    landings: int
    income: float  # per flying hour, as an observation holds it: float32 of a tenth
    to_go: int  # hours of the running mission that are left


@kernel(inline="always")
def between(nodes: np.ndarray, x: float) -> tuple[int, float]:
    """Index of the node below x and the share of the next one, within the ends of `nodes` float64 (N,)."""
    below = 0
    while below < nodes.shape[0] - 2 and nodes[below + 1] <= x:
        below += 1
    if nodes.shape[0] == 1:
        return 0, 0.0
    span = nodes[below + 1] - nodes[below]
    share = (x - nodes[below]) / span if span > 0 else 0.0  # a type whose planes all earn the same has no span
    return below, min(max(share, 0.0), 1.0)


@kernel(inline="always")
def index_of(known: Known, time: float, tables: IndexTables) -> float:
    """A plane's index; -inf where it will not fail any more.

    Counters that no plane of the generator can reach take those of the nearest that can.
    """
    kind, state, worn, landings = known.kind, known.to_go, known.hours, known.landings
    if known.broken:
        state = BROKEN
    elif worn > HOURS_CAP or landings > LANDINGS_CAP:
        return -np.inf
    landings = min(landings, LANDINGS_CAP)
    worn = min(max(worn, tables.first[kind, landings]), tables.last[kind, landings])
    s, later = between(tables.hours, time)
    j, more = between(tables.incomes[kind], known.income)
    total = 0.0
    for dj in range(min(2, tables.incomes.shape[1])):
        for ds in range(min(2, tables.hours.shape[0])):
            share = (more if dj else 1.0 - more) * (later if ds else 1.0 - later)
            total += share * tables.values[kind, j + dj, s + ds, state, landings, worn]
    return total


@kernel(inline="always")
def failure_probability(known: Known, failure: np.ndarray) -> float:
    """1 - prod(1 - p_k) over the parts of a plane, from float64 (n_types, n_parts, longest + 1)."""
    survival = 1.0
    for part in range(failure.shape[1]):
        survival *= 1.0 - failure[known.kind, part, known.landings if part == 0 else known.hours]
    return 1.0 - survival


@kernel(inline="always")
def rank(known: Known, time: int, failure: np.ndarray, of: Ranking) -> float:
    """A plane's rank; -inf for one that the rule never serves."""
    if of.rule == INDEX:
        return index_of(known, float(time), of.tables) if known.kind >= 0 else -np.inf
    if of.rule == PREVENTIVE_FIRST:
        # broken planes come last: their long repairs would eat the crews
        worn = known.hours >= of.hours if known.kind == 0 else known.landings >= of.landings
        if known.broken:
            return known.income
        return FIRST + known.hours * known.income if worn else -np.inf
    if known.broken:
        if of.rule == CORRECTIVE:
            return known.income
        return 0.0 if of.rule == CORRECTIVE_AS_PUBLISHED else FIRST + known.income
    if of.rule == PERIODIC:
        return float(known.hours)
    if of.rule == CONDITION:
        return float(known.hours) if known.hours >= of.hours else -np.inf
    if of.rule == MODEL_BASED:
        risk = failure_probability(known, failure)
        return risk if risk >= of.risk else -np.inf
    return -np.inf


def rank_observation(observation: Mapping[str, np.ndarray], failure: np.ndarray, of: Ranking) -> np.ndarray:
    """Ranks float64 (B, P + 1) of an observation's planes, -inf where nothing may be served.

    `failure` float64 (n_types, n_parts, longest + 1) covers every plane's counters.
    """
    # arrays from a message are read-only, which is another type to Numba
    plane = np.require(observation["plane"], np.float32, ["C", "W"])
    time = np.require(observation["time"], np.float32, ["C", "W"])
    legal = np.require(observation["action_mask"], np.int8, ["C", "W"])
    out = np.empty(legal.shape)
    _ranks()(plane, time, legal, failure, of, out)
    return out


@cache
def _ranks() -> Callable[..., None]:
    planes, legal = np.zeros((1, 1, 1), np.float32), np.zeros((1, 1), np.int8)
    return entry(ranks, planes, planes[0, 0], legal, np.zeros((1, 1, 1)), ranking(CORRECTIVE), np.zeros((1, 1)))


@kernel
def ranks(
    plane: np.ndarray, time: np.ndarray, legal: np.ndarray, failure: np.ndarray, of: Ranking, out: np.ndarray
) -> None:
    """Ranks, written to `out` float64 (B, P + 1), of the planes of observations; -inf where nothing may be served.

    `plane` float32 (B, P + 1, F), `time` (B,) and `legal` int8 (B, P + 1) are an observation's.
    """
    for b in range(plane.shape[0]):
        out[b] = -np.inf
        if time[b] % of.period != 0:
            continue
        for slot in range(1, plane.shape[1]):
            if legal[b, slot]:
                known = known_from(plane[b, slot])
                out[b, slot] = rank(known, int(time[b]), failure, of)


@kernel(inline="always")
def known_from(features: np.ndarray) -> Known:
    """What an observation says of a plane, from its features float32 (F,)."""
    kind = -1
    for k in range(N_FEATURES, features.shape[0]):
        if features[k] > 0:
            kind = k - N_FEATURES
    return Known(
        kind,
        features[_BROKEN] > 0,
        round(np.float64(features[HOURS]) * _PER_HOUR),
        round(np.float64(features[LANDINGS]) * _PER_LANDING),
        np.float64(features[_INCOME]) * _PER_INCOME,
        round(np.float64(features[_MISSION]) * _PER_MISSION - np.float64(features[_DONE]) * _PER_DONE),
    )

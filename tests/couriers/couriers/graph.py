"""What a courier sees: jobs and couriers whose place is within the reach of its view, as a graph.

Job slot 0 stands for doing nothing. Jobs come when they arrive and go when they are done or cancelled; a courier
that is away keeps its node, whose feature `available` is then 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marl_sched.errors import InvalidOptionError
from marl_sched.graph import AVAILABLE, Feature, Features, GraphSpec, NodeType, Relation

JOB = np.dtype([("there", "?"), ("taken", "?"), ("work", "i8"), ("arrival", "i8"), ("place", "i8")])
COURIER = np.dtype(
    [("there", "?"), ("available", "?"), ("free", "?"), ("acted", "?"), ("choice", "i8"), ("home", "i8")]
)

JOB_FEATURES = Features(
    Feature("nothing"), Feature("waiting"), Feature("work", 3, whole=True), Feature("waited", 10, whole=True),
    Feature("distance", 8, whole=True),
)  # fmt: skip
COURIER_FEATURES = Features(Feature("acting"), Feature(AVAILABLE), Feature("free"), Feature("acted"))
STATE_FEATURES = Features(Feature("jobs", 10, whole=True), Feature("waiting_share"), Feature("free_share"))

GRAPH = GraphSpec(
    nodes=(NodeType("job", JOB_FEATURES.labels), NodeType("courier", COURIER_FEATURES.labels)),
    state_features=STATE_FEATURES.labels,
    relations=(
        Relation("courier", "chose", "job", "scatter", index="chose"),
        Relation("job", "in", "state", "all", attention=True),
        Relation("courier", "in", "state", "all", attention=True),
        Relation("job", "to", "decision", "same"),
        Relation("state", "to", "decision", "all"),
    ),
    decision_of="job",
)


@dataclass(frozen=True)
class FullView:
    """Every courier sees everything."""

    kind = "full"
    hides = False

    @property
    def reach(self) -> int:
        """Farther than any two places are apart."""
        return 1 << 30


@dataclass(frozen=True)
class NearView:
    """A courier sees jobs and couriers whose place is at most `reach` from its home.

    What a courier out of its sight chose today it does not know; it may choose the same job and then idles.
    """

    kind = "near"
    hides = True

    reach: int = 3

    def __post_init__(self) -> None:
        """Refuse a negative reach."""
        if self.reach < 0:
            raise InvalidOptionError(f"view near: reach: expected an integer >= 0, got {self.reach}")


VIEWS: dict[str, type] = {"full": FullView, "near": NearView}


def write(
    jobs: np.ndarray, couriers: np.ndarray, day: int, agent: int, reach: int, n_jobs: int, out: Mapping[str, np.ndarray]
) -> None:
    """Write what one courier sees; jobs JOB (N + 1,), couriers COURIER (C,), arrays of `out` without batch axis."""
    for array in out.values():
        array[...] = 0
    out["chose"][...] = -1
    out["action_mask"][0] = out["job_mask"][0] = 1
    out["job"][0, JOB_FEATURES.index("nothing")] = 1
    out["time"][...] = day
    if agent < 0:
        return
    me = couriers[agent]
    heard = couriers["there"] & (np.abs(couriers["home"] - me["home"]) <= reach)
    seen = jobs["there"] & (np.abs(jobs["place"] - me["home"]) <= reach)
    chosen = np.zeros(len(jobs), bool)
    for c in np.flatnonzero(heard & (couriers["choice"] > 0)):
        chosen[couriers["choice"][c]] = True
        if seen[couriers["choice"][c]]:
            out["chose"][c] = couriers["choice"][c]
    waiting = seen & ~jobs["taken"] & ~chosen
    slots = np.flatnonzero(seen)
    out["job_mask"][slots] = 1
    JOB_FEATURES.write(out["job"], slots, waiting=waiting[slots], work=jobs["work"][slots])
    JOB_FEATURES.write(out["job"], slots, waited=day - jobs["arrival"][slots])
    JOB_FEATURES.write(out["job"], slots, distance=np.abs(jobs["place"][slots] - me["home"]))
    crew = np.flatnonzero(heard)
    out["courier_mask"][crew] = 1
    COURIER_FEATURES.write(out["courier"], crew, acting=crew == agent, available=couriers["available"][crew])
    COURIER_FEATURES.write(out["courier"], crew, free=couriers["free"][crew], acted=couriers["acted"][crew])
    if me["free"] and me["available"] and not me["acted"]:
        out["action_mask"][np.flatnonzero(waiting)] = 1
    free = np.mean(couriers["free"][crew])
    STATE_FEATURES.write(
        out["state"], ..., jobs=len(slots), waiting_share=np.sum(waiting) / max(len(slots), 1), free_share=free
    )
    out["visible_share"][...] = len(slots) / max(n_jobs, 1)

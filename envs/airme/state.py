"""Where an AirME simulator stands: plain arrays that compiled kernels read and write, and names of numbers in them.

Slot 0 of `planes` is the null plane, slots 1..n_planes are the fleet, so an action is a slot. Everything is integer
hours and float64 money.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Record = Any  # one element of a record array, whose fields compiled code reads as attributes

PLANE = np.dtype(
    [
        ("income", np.float64),  # per flying hour
        ("job_cost", np.float64),  # per hour of the running repair
        ("hours", np.int32),  # operating hours since the last repair
        ("landings", np.int32),
        ("kind", np.int32),  # index of the aircraft type
        ("crew", np.int32),  # who repairs it, -1: nobody
        ("job_hours", np.int32),  # length of the running repair
        ("job_done", np.int32),
        ("mission_hours", np.int32),  # length of the running mission, 0: grounded
        ("mission_done", np.int32),
        ("chosen", np.int32),  # the crew that chose it this hour, -1: none
        ("broken", np.bool_),
    ],
    align=True,
)
CREW = np.dtype(
    [
        ("plane", np.int32),  # the slot under repair, 0: free
        ("job_hours", np.int32),
        ("job_done", np.int32),
        ("choice", np.int32),  # this hour's action, IDLE or UNDECIDED
    ],
    align=True,
)
ROW = np.dtype(
    [
        ("n_planes", np.int64),
        ("n_crews", np.int64),
        ("total_income", np.float64),  # of all planes, what profit and revenue are divided by
        ("episode", np.uint64),  # key of the noise
        ("time", np.int64),  # hours
        ("acting", np.int64),  # the crew to act, -1: nobody
        ("reward", np.float64),
        ("elapsed", np.int64),
        ("sums", np.float64, (3,)),  # objectives summed over the hours so far
        ("conflict", np.bool_),
        ("terminated", np.bool_),
        ("truncated", np.bool_),
    ],
    align=True,
)

IDLE, UNDECIDED = 0, -1
EVERYWHERE = 1 << 30  # of a view: so far that it reaches all
PROFIT, REVENUE, AVAILABILITY = 0, 1, 2
OBJECTIVES = ("profit", "revenue", "availability")
FULL, SKIP, SINGLE = 0, 1, 2
SCHEMES = ("full", "skip", "single")
# What a plane does in an hour, for timelines.
GROUNDED, FLYING, BROKEN, REPAIR = 0, 1, 2, 3
# What is counted of a crew: hours in repair, repairs begun, hours free while a broken plane stood unattended.
REPAIRED, BEGUN, MISSED = 0, 1, 2


class State(NamedTuple):
    """Everything that changes, one row per instance: B rows, P planes, C crews, T hours, H hours of staleness."""

    rows: np.ndarray  # ROW (B,)
    planes: np.ndarray  # PLANE (B, P + 1)
    crews: np.ndarray  # CREW (B, C)
    series: np.ndarray  # float64 (B, T, 3), objectives of each hour
    timeline: np.ndarray  # uint8 (B, T, P + 1), what each plane did, or (0, 0, 0): not recorded
    jobs: np.ndarray  # int32 (B, T, C), the plane that each crew repaired, 0: none, or (0, 0, 0), as `timeline`
    work: np.ndarray  # int64 (B, C, 3), what each crew did so far: REPAIRED, BEGUN, MISSED, or (0, 0, 0): not counted
    past: np.ndarray  # PLANE (B, H + 1, P + 1), planes at the start of hour t in slot t mod (H + 1), or (B, 0, P + 1)
    private_memory: np.ndarray  # PLANE (B, C, P + 1), statuses that a crew learnt by itself, or (0, 0, 0)
    private_memory_at: np.ndarray  # int64 (B, C, P + 1), hour of that status, -1: never, or (0, 0, 0)


class Rules(NamedTuple):
    """What stays the same over an episode."""

    usage: np.ndarray  # float64 (n_types,), probability of starting a mission
    failure: np.ndarray  # float64 (n_types, parts, longest + 1), see aircraft.failure_table
    objective: int  # PROFIT, REVENUE or AVAILABILITY
    scheme: int  # FULL, SKIP or SINGLE, section 6.3.1
    horizon: int  # hours
    stop_share: float  # the episode ends when this share of planes is broken, 0: never

"""An AirME state as the heterogeneous graph that one crew sees (marl_sched.envs.airme.features)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.envs.airme.features import (
    AGE,
    BROKEN,
    CHOSEN,
    FLYING,
    FREE,
    HALF,
    HOURS,
    IN_REPAIR,
    INCOME,
    JOB_COST,
    JOB_DONE,
    JOB_HOURS,
    LANDINGS,
    MISSION_DONE,
    MISSION_HOURS,
    N_CREW,
    N_PLANE,
    N_STATE,
    NULL_PLANE,
    PER_AGE,
    PER_HOURS,
    PER_INCOME,
    PER_JOB_COST,
    PER_JOB_DONE,
    PER_JOB_HOURS,
    PER_LANDINGS,
    PER_MISSION_DONE,
    PER_MISSION_HOURS,
    TENTH,
    USAGE,
)
from marl_sched.envs.airme.state import EVERYWHERE, UNDECIDED, Record, State
from marl_sched.envs.airme.views import home_sector, ring_distance
from marl_sched.errors import InvalidOptionError
from marl_sched.kernels import kernel


class Arrays(NamedTuple):
    """The arrays of an observation that the kernel writes; see marl_sched.graph for shapes."""

    plane: np.ndarray
    plane_mask: np.ndarray
    crew: np.ndarray
    crew_mask: np.ndarray
    state: np.ndarray
    repairing: np.ndarray
    action_mask: np.ndarray
    time: np.ndarray
    visible_share: np.ndarray


@kernel
def observe(state: State, usage: np.ndarray, agents: np.ndarray, limits: np.ndarray, out: Arrays) -> None:
    """Write what each row's agent, int64 (B,), sees; a negative agent sees nothing.

    `usage` float64 (n_types,). `limits` int64 (B, 3): each row's reach, comm and staleness, see
    marl_sched.envs.airme.views.
    """
    require_fitting(state, len(usage), agents, limits, out)
    for b in range(agents.shape[0]):
        reach, comm, staleness = limits[b, 0], limits[b, 1], limits[b, 2]
        out.crew[b] = 0
        out.crew_mask[b] = 0
        out.state[b] = 0
        out.repairing[b] = -1
        out.action_mask[b] = 0
        out.action_mask[b, 0] = 1
        out.time[b] = state.rows[b].time
        if agents[b] >= 0:
            see_crews(state, b, agents[b], comm, out)
            see_planes(state, usage, b, agents[b], reach, staleness, out)
            hear_of_jobs(state, b, out)
            write_action_mask(state, b, agents[b], out)
            summarise(out, b, state.rows[b].n_planes)
        else:
            out.plane[b] = 0
            out.plane_mask[b] = 0
            out.visible_share[b] = 0


@kernel
def require_fitting(state: State, n_types: int, agents: np.ndarray, limits: np.ndarray, out: Arrays) -> None:
    """Raise InvalidOptionError where arrays or agents do not fit: compiled code does not check its indices."""
    batch, slots, crews = len(agents), state.planes.shape[1], state.crews.shape[1]
    fit = state.rows.shape[0] == batch and limits.shape == (batch, 3)
    fit &= out.plane.shape == (batch, slots, N_PLANE + n_types) and out.plane_mask.shape == (batch, slots)
    fit &= out.crew.shape == (batch, crews, N_CREW) and out.crew_mask.shape == (batch, crews)
    fit &= out.state.shape == (batch, N_STATE + n_types) and out.repairing.shape == (batch, crews)
    fit &= out.action_mask.shape == (batch, slots) and out.time.shape == out.visible_share.shape == (batch,)
    if not fit:
        raise InvalidOptionError("out: expected arrays of the shapes that new_observation() makes")
    for b in range(batch):
        if agents[b] >= crews:
            raise InvalidOptionError("agents: expected agents below max_agents")


@kernel
def see_crews(state: State, b: int, agent: int, comm: int, out: Arrays) -> None:
    """Crews within `comm`, with their present jobs."""
    n_crews = state.rows[b].n_crews
    for crew in range(n_crews):
        if ring_distance(agent, crew, n_crews) > comm:
            continue
        record = state.crews[b, crew]
        out.crew_mask[b, crew] = 1
        out.crew[b, crew, 0] = record.plane == 0
        out.crew[b, crew, 1] = record.plane > 0
        out.crew[b, crew, 2] = record.choice != UNDECIDED
        out.crew[b, crew, 3] = crew == agent
        out.crew[b, crew, 4] = record.job_hours * TENTH
        out.crew[b, crew, 5] = record.job_done * TENTH


@kernel
def see_planes(state: State, usage: np.ndarray, b: int, agent: int, reach: int, staleness: int, out: Arrays) -> None:
    """Planes of the sectors within `reach`, each as this crew knows it; all others are zero."""
    row = state.rows[b]
    n_crews, now = row.n_crews, row.time
    snapshot_hour = max(0, now - staleness)
    out.plane[b, 0] = 0
    out.plane[b, 0, NULL_PLANE] = 1
    out.plane_mask[b, 0] = 1
    visible = 0
    for slot in range(1, out.plane.shape[1]):
        sector = home_sector(slot, n_crews)
        if slot > row.n_planes or (reach < EVERYWHERE and ring_distance(agent, sector, n_crews) > reach):
            out.plane_mask[b, slot] = 0
            for k in range(out.plane.shape[2]):
                out.plane[b, slot, k] = 0
            continue
        visible += 1
        out.plane_mask[b, slot] = 1
        if sector == agent or staleness == 0:
            describe(state.planes[b, slot], usage, 0, out.plane, b, slot)
        elif state.private_memory_at[b, agent, slot] >= snapshot_hour:
            describe(
                state.private_memory[b, agent, slot],
                usage,
                now - state.private_memory_at[b, agent, slot],
                out.plane,
                b,
                slot,
            )
        else:
            describe(
                state.past[b, snapshot_hour % state.past.shape[1], slot], usage, now - snapshot_hour, out.plane, b, slot
            )
    out.visible_share[b] = visible / row.n_planes


@kernel(inline="always")
def describe(plane: Record, usage: np.ndarray, age: int, out: np.ndarray, b: int, slot: int) -> None:
    """A plane's features from its record; `age` is how many hours old the snapshot is.

    Whose choice it is this hour is not in the delayed snapshot: that is heard from crews within `comm`. A status in
    the private memory says so nevertheless, as somebody has the plane in hand.
    """
    in_hand = plane.crew >= 0 or (age > 0 and plane.chosen >= 0)
    out[b, slot, HOURS] = plane.hours * PER_HOURS
    out[b, slot, USAGE] = usage[plane.kind]
    out[b, slot, LANDINGS] = plane.landings * PER_LANDINGS
    out[b, slot, BROKEN] = plane.broken
    out[b, slot, INCOME] = plane.income * PER_INCOME
    out[b, slot, FREE] = not in_hand
    out[b, slot, IN_REPAIR] = in_hand
    out[b, slot, CHOSEN] = 0
    out[b, slot, JOB_HOURS] = plane.job_hours * PER_JOB_HOURS
    out[b, slot, JOB_COST] = plane.job_cost * PER_JOB_COST
    out[b, slot, JOB_DONE] = plane.job_done * PER_JOB_DONE
    out[b, slot, FLYING] = plane.mission_hours > 0
    out[b, slot, MISSION_HOURS] = plane.mission_hours * PER_MISSION_HOURS
    out[b, slot, MISSION_DONE] = plane.mission_done * PER_MISSION_DONE
    out[b, slot, AGE] = age * PER_AGE
    out[b, slot, NULL_PLANE] = 0
    for k in range(usage.shape[0]):
        out[b, slot, N_PLANE + k] = plane.kind == k


@kernel
def hear_of_jobs(state: State, b: int, out: Arrays) -> None:
    """What a visible crew says of its own work is newer than any delayed snapshot of the plane."""
    for crew in range(state.rows[b].n_crews):
        if out.crew_mask[b, crew] == 0:
            continue
        record = state.crews[b, crew]
        slot = max(record.plane, record.choice)
        if slot <= 0 or out.plane_mask[b, slot] == 0:
            continue
        out.repairing[b, crew] = slot
        out.plane[b, slot, FREE] = 0
        if record.plane > 0:
            out.plane[b, slot, IN_REPAIR] = 1
            out.plane[b, slot, JOB_HOURS] = record.job_hours * PER_JOB_HOURS
            out.plane[b, slot, JOB_DONE] = record.job_done * PER_JOB_DONE
        else:
            out.plane[b, slot, CHOSEN] = 1


@kernel
def write_action_mask(state: State, b: int, agent: int, out: Arrays) -> None:
    """The actions that are legal as far as the crew knows: visible planes that nobody has in hand."""
    if state.crews[b, agent].plane > 0 or state.crews[b, agent].choice != UNDECIDED:
        return
    for slot in range(1, state.rows[b].n_planes + 1):
        if out.plane[b, slot, FREE] == 1:
            out.action_mask[b, slot] = 1


@kernel
def summarise(out: Arrays, b: int, n_planes: int) -> None:
    """The state node's features, from visible nodes alone."""
    n_crews = 0
    for crew in range(out.crew.shape[1]):
        n_crews += out.crew_mask[b, crew]
        out.state[b, 5] += out.crew[b, crew, 0]
    out.state[b, 5] /= n_crews
    visible = 0
    for slot in range(1, n_planes + 1):
        if out.plane_mask[b, slot] == 0:
            continue
        visible += 1
        out.state[b, 0] += out.plane[b, slot, FREE]
        out.state[b, 1] += out.plane[b, slot, BROKEN]
        out.state[b, 2] += out.plane[b, slot, IN_REPAIR]
        out.state[b, 3] += out.plane[b, slot, FLYING]
        out.state[b, 6] += out.plane[b, slot, HOURS]
        out.state[b, 7] += out.plane[b, slot, LANDINGS]
        out.state[b, 8] += out.plane[b, slot, INCOME]
        for k in range(N_STATE, out.state.shape[1]):
            out.state[b, k] += out.plane[b, slot, N_PLANE + k - N_STATE]
    share = np.float32(1.0) / np.float32(max(visible, 1))
    for k in range(out.state.shape[1]):
        if k != 4 and k != 5:
            out.state[b, k] *= share
    out.state[b, 6] *= TENTH
    out.state[b, 7] *= HALF
    out.state[b, 4] = TENTH * visible / n_crews

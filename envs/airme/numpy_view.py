"""What one crew sees, in NumPy: the kernel `marl_sched.envs.airme.graph.observe` for agents that carry no Numba.

Equal to the kernel's arrays to the last bit: the same products in float64, and sums in float32 in the order of slots.
It takes three to ten times as long, which one decision does not mind; simulators use the kernel.
"""

from __future__ import annotations

import numpy as np

from marl_sched.envs.airme import features as f
from marl_sched.envs.airme.features import N_PLANE, N_STATE
from marl_sched.envs.airme.state import EVERYWHERE, UNDECIDED, State

Observation = dict[str, np.ndarray]
# State features that are means over visible planes, and the plane's features that they are means of.
_MEANS = np.array([0, 1, 2, 3, 6, 7, 8])
_OF = np.array([f.FREE, f.BROKEN, f.IN_REPAIR, f.FLYING, f.HOURS, f.LANDINGS, f.INCOME])
_PER_CREW, _FREE_CREWS, _MEAN_HOURS, _MEAN_LANDINGS = 4, 5, 6, 7


def observe(state: State, usage: np.ndarray, agent: int, limits: np.ndarray, out: Observation) -> None:
    """Write what an agent sees of row 0 into arrays with B = 1; `usage` and `limits` int64 (1, 3) as the kernel has."""
    reach, comm, staleness = limits[0].tolist()
    row = state.rows[0]
    n_planes, n_crews, now = int(row["n_planes"]), int(row["n_crews"]), int(row["time"])
    for array in out.values():
        array[0] = 0
    out["repairing"][0] = -1
    out["action_mask"][0, 0] = 1
    out["time"][0] = now
    crews = _see_crews(state, agent, comm, n_crews, out)
    slots = _visible_slots(agent, reach, n_planes, n_crews)
    plane = out["plane"][0]
    plane[0, f.NULL_PLANE] = 1
    out["plane_mask"][0, 0] = out["plane_mask"][0, slots] = 1
    out["visible_share"][0] = len(slots) / n_planes
    known, age = _known(state, agent, slots, n_crews, now, staleness)
    plane[slots] = _described(known, age, usage)
    _hear_of_jobs(state, crews, out)
    own = state.crews[0, agent]
    if own["plane"] <= 0 and own["choice"] == UNDECIDED:
        out["action_mask"][0, slots] = plane[slots, f.FREE] == 1
    _summarise(plane[slots], out["crew"][0, crews, 0], n_crews=len(crews), state=out["state"][0])


def _steps(agent: int, others: np.ndarray, n_crews: int) -> np.ndarray:
    """Ring distances int64 (n,) from a crew to others (marl_sched.envs.airme.views.ring_distance)."""
    steps = np.abs(agent - others)
    return np.minimum(steps, n_crews - steps)


def _visible_slots(agent: int, reach: int, n_planes: int, n_crews: int) -> np.ndarray:
    """The slots int64 (V,) of planes whose home is within reach."""
    slots = np.arange(1, n_planes + 1)
    if reach >= EVERYWHERE:
        return slots
    return slots[_steps(agent, (slots - 1) % n_crews, n_crews) <= reach]


def _see_crews(state: State, agent: int, comm: int, n_crews: int, out: Observation) -> np.ndarray:
    """Write crews within `comm` with their present jobs; their indices int64 (C,)."""
    crews = np.arange(n_crews)
    crews = crews[_steps(agent, crews, n_crews) <= comm]
    records, written = state.crews[0, crews], np.zeros((len(crews), f.N_CREW), np.float32)
    written[:, 0] = records["plane"] == 0
    written[:, 1] = records["plane"] > 0
    written[:, 2] = records["choice"] != UNDECIDED
    written[:, 3] = crews == agent
    written[:, 4] = records["job_hours"] * f.TENTH
    written[:, 5] = records["job_done"] * f.TENTH
    out["crew_mask"][0, crews] = 1
    out["crew"][0, crews] = written
    return crews


def _known(
    state: State, agent: int, slots: np.ndarray, n_crews: int, now: int, staleness: int
) -> tuple[np.ndarray, np.ndarray]:
    """The newest record PLANE (V,) that a crew has of each visible plane, and its age in hours, int64 (V,)."""
    known, age = state.planes[0, slots], np.zeros(len(slots), np.int64)
    if staleness == 0:
        return known, age
    snapshot_hour = max(0, now - staleness)
    others = np.flatnonzero((slots - 1) % n_crews != agent)
    known[others] = state.past[0, snapshot_hour % state.past.shape[1], slots[others]]
    age[others] = now - snapshot_hour
    remembered_at = state.private_memory_at[0, agent, slots]
    newer = others[remembered_at[others] >= snapshot_hour]
    known[newer] = state.private_memory[0, agent, slots[newer]]
    age[newer] = now - remembered_at[newer]
    return known, age


def _described(known: np.ndarray, age: np.ndarray, usage: np.ndarray) -> np.ndarray:
    """Features float32 (V, N_PLANE + n_types) of records PLANE (V,); see the kernel `describe`."""
    out = np.zeros((len(known), N_PLANE + len(usage)), np.float32)
    in_hand = (known["crew"] >= 0) | ((age > 0) & (known["chosen"] >= 0))
    out[:, f.HOURS] = known["hours"] * f.PER_HOURS
    out[:, f.USAGE] = usage[known["kind"]]
    out[:, f.LANDINGS] = known["landings"] * f.PER_LANDINGS
    out[:, f.BROKEN] = known["broken"]
    out[:, f.INCOME] = known["income"] * f.PER_INCOME
    out[:, f.FREE] = ~in_hand
    out[:, f.IN_REPAIR] = in_hand
    out[:, f.JOB_HOURS] = known["job_hours"] * f.PER_JOB_HOURS
    out[:, f.JOB_COST] = known["job_cost"] * f.PER_JOB_COST
    out[:, f.JOB_DONE] = known["job_done"] * f.PER_JOB_DONE
    out[:, f.FLYING] = known["mission_hours"] > 0
    out[:, f.MISSION_HOURS] = known["mission_hours"] * f.PER_MISSION_HOURS
    out[:, f.MISSION_DONE] = known["mission_done"] * f.PER_MISSION_DONE
    out[:, f.AGE] = age * f.PER_AGE
    out[np.arange(len(known)), N_PLANE + known["kind"]] = 1
    return out


def _hear_of_jobs(state: State, crews: np.ndarray, out: Observation) -> None:
    """What a visible crew says of its own work is newer than any delayed snapshot of the plane."""
    plane, mask = out["plane"][0], out["plane_mask"][0]
    records = state.crews[0, crews]
    slots = np.maximum(records["plane"], records["choice"])
    heard = np.flatnonzero((slots > 0) & (mask[slots] == 1))
    slots, records = slots[heard], records[heard]
    out["repairing"][0, crews[heard]] = slots
    plane[slots, f.FREE] = 0
    busy = records["plane"] > 0
    plane[slots[busy], f.IN_REPAIR] = 1
    plane[slots[busy], f.JOB_HOURS] = records["job_hours"][busy] * f.PER_JOB_HOURS
    plane[slots[busy], f.JOB_DONE] = records["job_done"][busy] * f.PER_JOB_DONE
    plane[slots[~busy], f.CHOSEN] = 1


def _summarise(plane: np.ndarray, free: np.ndarray, *, n_crews: int, state: np.ndarray) -> None:
    """Write the state node's features float32 (N_STATE + n_types,) from visible planes (V, ...) and crews."""
    if len(plane):
        # accumulate, not sum: one after the other, as the kernel adds
        sums = np.add.accumulate(plane, axis=0, dtype=np.float32)[-1]
        state[_MEANS] = sums[_OF]
        state[N_STATE:] = sums[N_PLANE:]
    state *= np.float32(1.0) / np.float32(max(len(plane), 1))
    state[_MEAN_HOURS] *= f.TENTH
    state[_MEAN_LANDINGS] *= f.HALF
    state[_FREE_CREWS] = np.float64(free.sum(dtype=np.float32)) / n_crews
    state[_PER_CREW] = np.float64(f.TENTH) * len(plane) / n_crews

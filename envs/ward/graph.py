"""What one nurse sees of a ward, written into the arrays of an observation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.envs.ward.dynamics import (
    ACTIVE,
    ADMISSION,
    BIRTH,
    RECOVERY,
    UNDECIDED,
    Record,
    State,
    cost_rate,
    distance,
    free_beds,
    may_be_taken,
)
from marl_sched.envs.ward.features import (
    ATTENDED,
    CHOSEN,
    DISTANCE,
    FIRST,
    HIGH_RISK,
    IN_BED,
    IN_HAND,
    MINE,
    N_BED,
    N_NURSE,
    N_PATIENT,
    N_STATE,
    NEGLECT_COST,
    NOBODY,
    PER_BEDS,
    PER_BUSY,
    PER_COST,
    PER_DISTANCE,
    PER_LOAD,
    PER_PATIENTS,
    PER_RANK,
    PER_STAY,
    RANK,
    SAVING,
    STAGE,
    STAY,
)
from marl_sched.envs.ward.lookahead import expected_rates, savings
from marl_sched.errors import InvalidOptionError
from marl_sched.kernels import kernel

_RATES = expected_rates(ADMISSION)


class Arrays(NamedTuple):
    """The arrays of an observation that the kernel writes; see marl_sched.graph for shapes."""

    patient: np.ndarray
    patient_mask: np.ndarray
    nurse: np.ndarray
    nurse_mask: np.ndarray
    bed: np.ndarray
    bed_mask: np.ndarray
    state: np.ndarray
    carer: np.ndarray
    place: np.ndarray
    action_mask: np.ndarray
    time: np.ndarray
    visible_share: np.ndarray


@kernel
def observe(state: State, agents: np.ndarray, limits: np.ndarray, out: Arrays) -> None:
    """Write what each row's nurse, int64 (B,), sees; a negative one sees nothing. `limits` int64 (2,): reach, comm."""
    require_fitting(state, agents, out)
    for b in range(len(agents)):
        observe_row(state, b, agents[b], limits, out)


@kernel
def observe_row(state: State, b: int, agent: int, limits: np.ndarray, out: Arrays) -> None:
    """Write what the nurse of one row sees."""
    for k in range(out.patient.shape[1]):
        out.carer[b, k] = -1
        out.place[b, k] = -1
    out.patient[b] = 0
    out.patient_mask[b] = 0
    out.nurse[b] = 0
    out.nurse_mask[b] = 0
    out.bed[b] = 0
    out.bed_mask[b] = 0
    out.state[b] = 0
    out.action_mask[b] = 0
    out.action_mask[b, 0] = 1
    out.patient[b, 0, NOBODY] = 1
    out.patient_mask[b, 0] = 1
    out.time[b] = state.rows[b]["time"]
    out.visible_share[b] = 0
    if agent >= 0:
        see_patients(state, b, agent, limits[0], out)
        hear_nurses(state, b, agent, limits[1], out)
        see_beds(state, b, agent, limits[0], out)
        write_action_mask(state, b, agent, out)
        rank_takeovers(out, b)
        summarise(state, b, out)


@kernel
def require_fitting(state: State, agents: np.ndarray, out: Arrays) -> None:
    """Raise InvalidOptionError where arrays or agents do not fit: compiled code does not check its indices."""
    batch, slots, nurses, beds = len(agents), state.patients.shape[1], state.nurses.shape[1], state.beds.shape[1]
    fit = state.rows.shape[0] == batch
    fit &= out.patient.shape == (batch, slots, N_PATIENT) and out.patient_mask.shape == (batch, slots)
    fit &= out.nurse.shape == (batch, nurses, N_NURSE) and out.nurse_mask.shape == (batch, nurses)
    fit &= out.bed.shape == (batch, beds, N_BED) and out.bed_mask.shape == (batch, beds)
    fit &= out.state.shape == (batch, N_STATE) and out.action_mask.shape == (batch, slots)
    fit &= out.carer.shape == out.place.shape == (batch, slots)
    fit &= out.time.shape == out.visible_share.shape == (batch,)
    if not fit:
        raise InvalidOptionError("out: expected arrays of the shapes that new_observation() makes")
    for b in range(batch):
        if agents[b] >= nurses:
            raise InvalidOptionError("agents: expected agents below max_agents")


@kernel
def see_patients(state: State, b: int, agent: int, reach: int, out: Arrays) -> None:
    """Patients of sections within `reach`."""
    row, me = state.rows[b], state.nurses[b, agent]
    visible = 0
    for slot in range(1, row["n_patients"] + 1):
        patient = state.patients[b, slot]
        if not patient["there"] or distance(me, patient) > reach:
            continue
        visible += 1
        out.patient_mask[b, slot] = 1
        describe(patient, agent, row["time"], out.patient, b, slot)
        out.patient[b, slot, DISTANCE] = distance(me, patient) * PER_DISTANCE
        out.place[b, slot] = patient["bed"]
    out.visible_share[b] = visible / max(row["present"], 1)


@kernel(inline="always")
def describe(patient: Record, agent: int, time: int, out: np.ndarray, b: int, slot: int) -> None:
    """A patient's features, but for what nurses have chosen and how far she is."""
    out[b, slot, STAGE + patient["stage"]] = 1
    out[b, slot, FIRST] = patient["first"]
    out[b, slot, HIGH_RISK] = patient["high_risk"]
    out[b, slot, IN_BED] = patient["bed"] >= 0
    out[b, slot, ATTENDED] = patient["attended"]
    out[b, slot, MINE] = patient["nurse"] == agent
    out[b, slot, IN_HAND] = patient["in_hand"]
    out[b, slot, STAY] = (time - patient["arrival"]) * PER_STAY
    out[b, slot, NEGLECT_COST] = cost_rate(patient) * PER_COST


@kernel
def hear_nurses(state: State, b: int, agent: int, comm: int, out: Arrays) -> None:
    """Nurses whose home is within `comm`: their load, whom they care for and what they chose in this quarter."""
    row, me = state.rows[b], state.nurses[b, agent]
    for n in range(row["n_nurses"]):
        nurse = state.nurses[b, n]
        if abs(nurse["home"] - me["home"]) > comm:
            continue
        out.nurse_mask[b, n] = 1
        out.nurse[b, n, 0] = n == agent
        out.nurse[b, n, 1] = nurse["choice"] != UNDECIDED
        out.nurse[b, n, 2] = nurse["busy"] * PER_BUSY
        out.nurse[b, n, 3] = nurse["load"] * PER_LOAD
        out.nurse[b, n, 4] = nurse["patients"] * PER_PATIENTS
        out.nurse[b, n, 5] = abs(nurse["home"] - me["home"]) * PER_DISTANCE
        if nurse["choice"] > 0 and out.patient_mask[b, nurse["choice"]] == 1:
            out.patient[b, nurse["choice"], CHOSEN] = 1
    for slot in range(1, row["n_patients"] + 1):
        carer = state.patients[b, slot]["nurse"]
        if out.patient_mask[b, slot] == 1 and carer >= 0 and out.nurse_mask[b, carer] == 1:
            out.carer[b, slot] = carer


@kernel
def see_beds(state: State, b: int, agent: int, reach: int, out: Arrays) -> None:
    """Beds of sections within `reach`."""
    row, me = state.rows[b], state.nurses[b, agent]
    for k in range(row["n_beds"]):
        bed = state.beds[b, k]
        apart = abs(bed["section"] - me["home"])
        if apart <= reach:
            out.bed_mask[b, k] = 1
            out.bed[b, k, 0] = bed["patient"] == 0
            out.bed[b, k, 1] = apart == 0
            out.bed[b, k, 2] = apart * PER_DISTANCE


@kernel
def own_free_beds(state: State, b: int, agent: int, out: Arrays) -> int:
    """Free beds of the nurse's section that no nurse of it has chosen for a patient in this quarter.

    These nurses have her view, and she hears them under every view.
    """
    row, me = state.rows[b], state.nurses[b, agent]
    free = free_beds(state.beds[b], row["n_beds"], me["home"])
    for n in range(row["n_nurses"]):
        nurse = state.nurses[b, n]
        if out.nurse_mask[b, n] == 1 and nurse["home"] == me["home"] and nurse["choice"] > 0:
            free -= state.patients[b, nurse["choice"]]["bed"] < 0
    return free


@kernel
def write_action_mask(state: State, b: int, agent: int, out: Arrays) -> None:
    """The patients whom the nurse may take over as far as she knows."""
    me = state.nurses[b, agent]
    free = own_free_beds(state, b, agent, out)
    out.state[b, 0] = me["load"] * PER_LOAD
    out.state[b, 1] = free * PER_BEDS
    if me["busy"] > 0 or me["choice"] != UNDECIDED:
        return
    for slot in range(1, state.rows[b]["n_patients"] + 1):
        if out.patient_mask[b, slot] == 0 or out.patient[b, slot, CHOSEN] == 1:
            continue
        patient = state.patients[b, slot]
        if may_be_taken(patient, agent) and (patient["bed"] >= 0 or free > 0):
            out.action_mask[b, slot] = 1


@kernel
def rank_takeovers(out: Arrays, b: int) -> None:
    """What each legal takeover saves while an admission lasts, and its place in the order of these savings.

    Doing nothing saves nothing and has a place too; of equal savings the lower slot comes first.
    """
    legal = out.action_mask[b]
    saved = np.empty(len(legal))
    savings(out.patient[b], legal, _RATES, ADMISSION, saved)
    for slot in range(len(legal)):
        if legal[slot] == 0:
            continue
        better = 0
        for other in range(len(legal)):
            better += legal[other] > 0 and (
                saved[other] > saved[slot] or (saved[other] == saved[slot] and other < slot)
            )
        out.patient[b, slot, SAVING] = saved[slot] * PER_COST
        out.patient[b, slot, RANK] = better * PER_RANK


@kernel
def summarise(state: State, b: int, out: Arrays) -> None:
    """The state node's features, from visible nodes alone."""
    row = state.rows[b]
    patients, nurses, beds, free = 0, 0, 0, 0
    for slot in range(1, row["n_patients"] + 1):
        if out.patient_mask[b, slot] == 0:
            continue
        patients += 1
        in_bed, attended = out.patient[b, slot, IN_BED], out.patient[b, slot, ATTENDED]
        out.state[b, 3] += 1 - in_bed
        out.state[b, 4] += in_bed * (1 - attended)
        out.state[b, 5] += out.patient[b, slot, STAGE + ACTIVE]
        out.state[b, 6] += out.patient[b, slot, STAGE + BIRTH]
        out.state[b, 7] += out.patient[b, slot, STAGE + RECOVERY]
        out.state[b, 9] += out.patient[b, slot, NEGLECT_COST] * (1 - attended)
        out.state[b, 10] += out.patient[b, slot, NEGLECT_COST] * out.patient[b, slot, MINE]
    for k in range(3, 10):
        out.state[b, k] /= max(patients, 1)
    for n in range(row["n_nurses"]):
        nurses += out.nurse_mask[b, n]
    for k in range(row["n_beds"]):
        beds += out.bed_mask[b, k]
        free += out.bed_mask[b, k] * (state.beds[b, k]["patient"] == 0)
    out.state[b, 2] = patients / nurses * PER_PATIENTS
    out.state[b, 8] = free / beds

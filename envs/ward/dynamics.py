"""The delivery ward as compiled kernels over plain arrays.

A quarter of an hour passes in this order: choices made in it take effect, nurses give care, the costs of the quarter
are booked, labour progresses, patients leave, walks and handovers come a quarter nearer to their end, patients arrive.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from marl_sched.envs.ward.instance import QUARTERS
from marl_sched.kernels import kernel
from marl_sched.noise import FIRST_DOMAIN_STREAM, time_key, uniform

Record = Any  # a structured scalar: Numba knows its fields

EARLY, ACTIVE, BIRTH, RECOVERY = range(4)
OBJECTIVES = ("cost", "census")
COST, CENSUS = range(2)

CAPACITY = 4  # of a nurse, in units of load
LOAD = np.array([1, 2, 4, 1])  # of a patient by stage: birth needs a nurse for herself
ORDER_OF_CARE = np.array([BIRTH, ACTIVE, RECOVERY, EARLY])
MEAN_QUARTERS = np.array([[16.0, 12.0, 4.0, 8.0], [24.0, 18.0, 6.0, 8.0]])  # of a stage; second row: first births
PROGRESS = 1.0 / MEAN_QUARTERS
WAITING_COST = np.array([0.5, 2.0, 8.0, 4.0])  # an hour without a bed, by stage
UNATTENDED_COST = np.array([0.25, 1.0, 8.0, 0.5])  # an hour in bed without care, by stage
HIGH_RISK_FACTOR = 2.0
ADMISSION, HANDOVER = 2, 1  # quarters with a patient who waited or lay in bed until she is taken over
UNDECIDED, NOBODY = -1, -1


class Stream(IntEnum):
    """Noise of the ward."""

    LABOUR = FIRST_DOMAIN_STREAM  # whether a stage ends in this quarter, entity = patient


_LABOUR = int(Stream.LABOUR)

ROW = np.dtype(
    [
        ("n_patients", "i8"), ("n_nurses", "i8"), ("n_beds", "i8"), ("episode", "u8"), ("time", "i8"), ("acting", "i8"),
        ("reward", "f8"), ("elapsed", "i8"), ("conflict", "?"), ("terminated", "?"), ("truncated", "?"),
        ("cost", "f8"), ("census", "f8"), ("present", "i8"), ("discharged", "i8"),
    ]
)  # fmt: skip
PATIENT = np.dtype(
    [
        ("arrival", "i8"), ("first", "?"), ("high_risk", "?"),
        ("there", "?"), ("stage", "i8"), ("section", "i8"),  # where she waits or lies
        ("bed", "i8"), ("nurse", "i8"),  # -1: none
        ("attended", "?"),  # in the last quarter
        ("in_hand", "?"),  # her nurse is on the way to her, or admits her or takes her over
    ]
)  # fmt: skip
NURSE = np.dtype(
    [
        ("home", "i8"), ("busy", "i8"),  # quarters until she has taken over `patient`
        ("handling", "i8"),  # the last quarters of `busy`, in which she is with the patient
        ("patient", "i8"), ("choice", "i8"), ("load", "i8"), ("patients", "i8"),
    ]
)  # fmt: skip
BED = np.dtype([("section", "i8"), ("patient", "i8")])


class State(NamedTuple):
    """Everything that a batch of episodes stands in."""

    rows: np.ndarray  # ROW (B,)
    patients: np.ndarray  # PATIENT (B, P + 1), slot 0 is nobody
    nurses: np.ndarray  # NURSE (B, N)
    beds: np.ndarray  # BED (B, n_beds)
    work: np.ndarray  # int64 (B, N, 3): quarters with care or a takeover, takeovers, quarters overloaded
    timeline: np.ndarray  # uint8 (B, T, n_beds), or empty: what each bed held, see `_shown`


class Rules(NamedTuple):
    """What holds for all rows."""

    objective: int
    end: int  # quarters


@kernel(inline="always")
def distance(nurse: Record, patient: Record) -> int:
    """Sections between a nurse's home and a patient."""
    return abs(nurse["home"] - patient["section"])


@kernel(inline="always")
def cost_rate(patient: Record) -> float:
    """What an hour costs in which nobody cares for a patient."""
    stage = patient["stage"]
    rate = WAITING_COST[stage] if patient["bed"] < 0 else UNATTENDED_COST[stage]
    return rate * HIGH_RISK_FACTOR if patient["high_risk"] else rate


@kernel(inline="always")
def may_be_taken(patient: Record, n: int) -> bool:
    """Whether nurse n may take over a patient for whom nobody has decided in this quarter; beds are another matter.

    She waits, or lies in bed under another nurse and had no care in the last quarter; and nobody is on the way to her.
    """
    if not patient["there"] or patient["in_hand"]:
        return False
    return patient["bed"] < 0 or (patient["nurse"] != n and not patient["attended"])


@kernel
def free_beds(beds: np.ndarray, n_beds: int, section: int) -> int:
    """Beds of a section in which nobody lies."""
    free = 0
    for k in range(n_beds):
        if beds[k]["section"] == section and beds[k]["patient"] == 0:
            free += 1
    return free


@kernel
def is_possible(state: State, b: int, n: int, slot: int) -> bool:
    """Whether nurse n can take over the patient in a slot, as things and all choices of this quarter are in truth."""
    row, patients, nurses = state.rows[b], state.patients[b], state.nurses[b]
    if slot > row["n_patients"] or not may_be_taken(patients[slot], n):
        return False
    free = free_beds(state.beds[b], row["n_beds"], nurses[n]["home"])
    for other in range(row["n_nurses"]):
        choice = nurses[other]["choice"]
        if choice == slot:
            return False
        if choice > 0 and patients[choice]["bed"] < 0 and nurses[other]["home"] == nurses[n]["home"]:
            free -= 1
    return patients[slot]["bed"] >= 0 or free > 0


@kernel
def take_over(state: State, b: int, n: int, slot: int) -> None:
    """Send nurse n to a patient; one who waits gets the first free bed of the nurse's section."""
    nurse, patient, beds = state.nurses[b, n], state.patients[b, slot], state.beds[b]
    nurse["handling"] = ADMISSION if patient["bed"] < 0 else HANDOVER
    nurse["busy"] = nurse["handling"] + distance(nurse, patient)
    nurse["patient"] = slot
    patient["nurse"] = n
    patient["in_hand"] = True
    state.work[b, n, 1] += 1
    if patient["bed"] < 0:
        for k in range(state.rows[b]["n_beds"]):
            if beds[k]["section"] == nurse["home"] and beds[k]["patient"] == 0:
                beds[k]["patient"] = slot
                patient["bed"] = k
                patient["section"] = nurse["home"]
                break


@kernel
def give_care(state: State, b: int) -> None:
    """Let every nurse attend to her patients: by stage in the order of care, high risk first, then by slot.

    A nurse who takes over a patient attends to her alone, once she is there. A patient whose load does not fit into
    what is left of the nurse's capacity goes without.
    """
    row, patients, nurses = state.rows[b], state.patients[b], state.nurses[b]
    for slot in range(1, row["n_patients"] + 1):
        patients[slot]["attended"] = False
    for n in range(row["n_nurses"]):
        if nurses[n]["busy"] > 0:
            state.work[b, n, 0] += 1
            if nurses[n]["busy"] <= nurses[n]["handling"]:
                patients[nurses[n]["patient"]]["attended"] = True
            continue
        state.work[b, n, 0] += nurses[n]["patients"] > 0
        state.work[b, n, 2] += nurses[n]["load"] > CAPACITY
        left = CAPACITY
        for stage in ORDER_OF_CARE:
            for high_risk in (True, False):
                for slot in range(1, row["n_patients"] + 1):
                    patient = patients[slot]
                    if patient["nurse"] != n or patient["stage"] != stage or patient["high_risk"] != high_risk:
                        continue
                    if LOAD[stage] <= left:
                        left -= LOAD[stage]
                        patient["attended"] = True


@kernel
def progress(state: State, b: int) -> None:
    """Draw which stages end in this quarter; recovery goes on only with care, and ends with leaving the ward."""
    row, patients = state.rows[b], state.patients[b]
    time_word = time_key(row["episode"], row["time"])
    for slot in range(1, row["n_patients"] + 1):
        patient = patients[slot]
        if not patient["there"] or (patient["stage"] == RECOVERY and not patient["attended"]):
            continue
        if uniform(time_word, _LABOUR, slot, 0) < PROGRESS[int(patient["first"]), patient["stage"]]:
            if patient["stage"] == RECOVERY:
                discharge(state, b, slot)
            else:
                patient["stage"] += 1


@kernel
def discharge(state: State, b: int, slot: int) -> None:
    """Let a patient leave: her bed is free, and so is a nurse who was taking her over."""
    patient = state.patients[b, slot]
    nurse = state.nurses[b, patient["nurse"]]
    if patient["in_hand"]:
        nurse["busy"] = 0
        nurse["handling"] = 0
        nurse["patient"] = 0
    state.beds[b, patient["bed"]]["patient"] = 0
    patient["there"] = False
    patient["in_hand"] = False
    patient["attended"] = False
    patient["nurse"] = NOBODY
    patient["bed"] = -1
    state.rows[b]["discharged"] += 1


@kernel
def arrive(state: State, b: int) -> None:
    """Let the patients of this quarter come, and count who is there and whom each nurse has."""
    row, patients, nurses = state.rows[b], state.patients[b], state.nurses[b]
    for n in range(row["n_nurses"]):
        nurses[n]["choice"] = UNDECIDED
        nurses[n]["load"] = 0
        nurses[n]["patients"] = 0
    present = 0
    for slot in range(1, row["n_patients"] + 1):
        patient = patients[slot]
        if patient["arrival"] == row["time"]:
            patient["there"] = True
        if patient["there"]:
            present += 1
            if patient["nurse"] >= 0:
                nurses[patient["nurse"]]["load"] += LOAD[patient["stage"]]
                nurses[patient["nurse"]]["patients"] += 1
    row["present"] = present


@kernel
def quarter(state: State, rules: Rules, b: int) -> None:
    """Let a quarter of an hour pass; see the module's page for the order of events."""
    row, patients, nurses = state.rows[b], state.patients[b], state.nurses[b]
    for n in range(row["n_nurses"]):
        if nurses[n]["choice"] > 0:
            take_over(state, b, n, nurses[n]["choice"])
    give_care(state, b)
    cost = 0.0
    for slot in range(1, row["n_patients"] + 1):
        if patients[slot]["there"] and not patients[slot]["attended"]:
            cost += cost_rate(patients[slot])
    cost /= QUARTERS
    census = row["present"] / QUARTERS
    row["cost"] += cost
    row["census"] += census
    row["reward"] -= cost if rules.objective == COST else census
    if state.timeline.shape[0] > 0:
        for k in range(row["n_beds"]):
            state.timeline[b, row["time"], k] = shown(state, b, k)
    progress(state, b)
    for n in range(row["n_nurses"]):
        nurse = nurses[n]
        if nurse["busy"] > 0:
            nurse["busy"] -= 1
            if nurse["busy"] == 0:
                patients[nurse["patient"]]["in_hand"] = False
                nurse["patient"] = 0
                nurse["handling"] = 0
    row["time"] += 1
    row["elapsed"] += 1
    arrive(state, b)
    row["truncated"] = row["time"] >= rules.end


@kernel(inline="always")
def shown(state: State, b: int, k: int) -> int:
    """What a picture shows of a bed: 0 free, 1 + stage of a patient with care, 5 a patient without."""
    slot = state.beds[b, k]["patient"]
    if slot == 0:
        return 0
    patient = state.patients[b, slot]
    return patient["stage"] + 1 if patient["attended"] else 5


@kernel
def find_turn(state: State, rules: Rules, b: int) -> None:
    """Let time pass until a nurse can choose or the episode is over."""
    row, nurses = state.rows[b], state.nurses[b]
    row["acting"] = NOBODY
    while not row["truncated"]:
        for n in range(row["n_nurses"]):
            if nurses[n]["busy"] == 0 and nurses[n]["choice"] == UNDECIDED:
                row["acting"] = n
                return
        quarter(state, rules, b)


@kernel
def require_consistent(state: State, rules: Rules, batch: int) -> None:
    """Raise ValueError where arrays do not belong together or a row does not fit into them: writing would go astray.

    Compiled code does not check its indices, so every entry point that writes begins with this.
    """
    slots, nurses, beds = state.patients.shape[1], state.nurses.shape[1], state.beds.shape[1]
    fit = state.rows.shape[0] == state.patients.shape[0] == state.nurses.shape[0] == state.beds.shape[0] == batch
    fit &= state.work.shape == (batch, nurses, 3)
    fit &= state.timeline.shape[0] == 0 or state.timeline.shape == (batch, rules.end, beds)
    if not fit:
        raise ValueError("the arrays of this state do not belong together")
    for b in range(batch):
        row = state.rows[b]
        if row["n_patients"] >= slots or row["n_nurses"] > nurses or row["n_beds"] > beds or row["acting"] >= nurses:
            raise ValueError("a row of this state does not fit into its arrays")
        if row["time"] < 0 or (row["time"] >= rules.end and not row["truncated"]):
            raise ValueError("a row of this state runs on after its horizon")


@kernel
def step(state: State, rules: Rules, actions: np.ndarray) -> int:
    """Take one turn in every row that is not over; actions int64 (B,).

    Returns the first row whose action is no slot, with nothing done anywhere, or -1.
    """
    require_consistent(state, rules, len(actions))
    for b in range(len(actions)):
        if actions[b] < 0 or actions[b] >= state.patients.shape[1]:
            return b
    for b in range(len(actions)):
        row = state.rows[b]
        row["reward"] = 0.0
        row["elapsed"] = 0
        row["conflict"] = False
        if row["acting"] < 0:
            continue
        choice = actions[b]
        if choice > 0 and not is_possible(state, b, row["acting"], choice):
            row["conflict"] = True
            choice = 0
        state.nurses[b, row["acting"]]["choice"] = choice
        find_turn(state, rules, b)
    return -1


@kernel
def begin(state: State, rules: Rules, b: int) -> None:
    """Bring a row whose instance was filled in to its first turn."""
    arrive(state, b)
    find_turn(state, rules, b)
    state.rows[b]["reward"] = 0.0
    state.rows[b]["elapsed"] = 0

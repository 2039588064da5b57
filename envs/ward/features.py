"""The named features of a ward's nodes and its metagraph (dissertation, section 7.2 and figure 7.1).

Patients, nurses and beds are nodes; a decision is a patient whom the acting nurse may take over, with a bed of her own
section if the patient waits for one. Patient slot 0 is nobody: do nothing.
"""

from __future__ import annotations

from marl_sched.graph import Feature, Features, GraphSpec, NodeType, Relation

PATIENT = Features(
    Feature("nobody"), Feature("early"), Feature("active"), Feature("birth"), Feature("recovery"),
    Feature("first_birth"), Feature("high_risk"), Feature("in_bed"), Feature("attended"), Feature("mine"),
    Feature("in_hand"), Feature("chosen"), Feature("distance", 2, whole=True), Feature("stay", 40, whole=True),
    Feature("neglect_cost", 8), Feature("saving", 8), Feature("rank", 10, whole=True),
)  # fmt: skip
NURSE = Features(
    Feature("acting"), Feature("chose"), Feature("busy", 4, whole=True), Feature("load", 4, whole=True),
    Feature("patients", 4, whole=True), Feature("distance", 2, whole=True),
)  # fmt: skip
BED = Features(Feature("free"), Feature("own_section"), Feature("distance", 2, whole=True))
STATE = Features(
    Feature("own_load", 4, whole=True), Feature("own_free_beds", 4, whole=True), Feature("patients_per_nurse", 4),
    Feature("waiting_share"), Feature("unattended_share"), Feature("active_share"), Feature("birth_share"),
    Feature("recovery_share"), Feature("free_bed_share"), Feature("mean_neglect_cost", 8),
    Feature("own_neglect_cost", 8),
)  # fmt: skip
(
    NOBODY, STAGE, _, _, _, FIRST, HIGH_RISK, IN_BED, ATTENDED, MINE, IN_HAND, CHOSEN, DISTANCE, STAY, NEGLECT_COST,
    SAVING, RANK,
) = range(len(PATIENT))  # fmt: skip
PER_DISTANCE, PER_STAY, PER_COST, PER_RANK = map(PATIENT.factor, ("distance", "stay", "neglect_cost", "rank"))
PER_BUSY, PER_LOAD, PER_PATIENTS = map(NURSE.factor, ("busy", "load", "patients"))
PER_BEDS = STATE.factor("own_free_beds")
N_PATIENT, N_NURSE, N_BED, N_STATE = len(PATIENT), len(NURSE), len(BED), len(STATE)

GRAPH = GraphSpec(
    nodes=(NodeType("patient", PATIENT.labels), NodeType("nurse", NURSE.labels), NodeType("bed", BED.labels)),
    state_features=STATE.labels,
    relations=(
        Relation("patient", "cared_for_by", "nurse", "scatter", index="carer"),
        Relation("nurse", "cares_for", "patient", "gather", index="carer"),
        Relation("patient", "lies_in", "bed", "scatter", index="place"),
        Relation("bed", "holds", "patient", "gather", index="place"),
        Relation("patient", "in", "state", "all", attention=True),
        Relation("nurse", "in", "state", "all", attention=True),
        Relation("bed", "in", "state", "all", attention=True),
        Relation("patient", "to", "decision", "same"),
        Relation("state", "to", "decision", "all"),
    ),
    decision_of="patient",
)

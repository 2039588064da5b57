"""The named features of AirME's nodes and its metagraph (dissertation, section 6.3.2 and figure 6.2).

Plane slot 0 is the null plane. The state node holds shares and ratios of what is visible, never raw counts,
so that a policy meets the same range of values at every scale.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from marl_sched.graph import Feature, Features, GraphSpec, NodeType, Relation

PLANE = Features(
    Feature("hours", 10, whole=True), Feature("usage_probability"), Feature("landings", 5, whole=True),
    Feature("broken"), Feature("income", 10), Feature("free"), Feature("in_repair"), Feature("chosen_this_hour"),
    Feature("job_hours", 10, whole=True), Feature("job_cost_per_hour", 10), Feature("job_done", 10, whole=True),
    Feature("flying"), Feature("mission_hours", 10, whole=True), Feature("mission_done", 10, whole=True),
    Feature("age_hours", 10, whole=True), Feature("null_plane"),
)  # fmt: skip
CREW_FEATURES = Features(
    Feature("free"), Feature("busy"), Feature("chose_this_hour"), Feature("acting"),
    Feature("job_hours", 10, whole=True), Feature("job_done", 10, whole=True),
)  # fmt: skip
STATE_FEATURES = Features(
    Feature("free_share"), Feature("broken_share"), Feature("in_repair_share"), Feature("flying_share"),
    Feature("planes_per_crew", 10), Feature("free_crews_share"), Feature("mean_hours", 100),
    Feature("mean_landings", 10), Feature("mean_income", 10),
)  # fmt: skip
_PLANE, _CREW, _STATE = PLANE.labels, CREW_FEATURES.labels, STATE_FEATURES.labels
(
    HOURS, USAGE, LANDINGS, BROKEN, INCOME, FREE, IN_REPAIR, CHOSEN, JOB_HOURS, JOB_COST, JOB_DONE, FLYING,
    MISSION_HOURS, MISSION_DONE, AGE, NULL_PLANE,
) = range(len(PLANE))  # fmt: skip
(
    PER_HOURS, PER_LANDINGS, PER_INCOME, PER_JOB_HOURS, PER_JOB_COST, PER_JOB_DONE, PER_MISSION_HOURS, PER_MISSION_DONE,
    PER_AGE,
) = map(
    PLANE.factor,
    (
        "hours", "landings", "income", "job_hours", "job_cost_per_hour", "job_done", "mission_hours", "mission_done",
        "age_hours",
    ),
)  # fmt: skip
INCOME_SCALE = PLANE.scale("income")
TENTH, HALF = np.float32(0.1), np.float32(0.5)
N_PLANE, N_CREW, N_STATE = len(_PLANE), len(_CREW), len(_STATE)


def graph_spec(n_types: int) -> GraphSpec:
    """The metagraph for a fleet with that many aircraft types, whose one-hot ends the plane's features.

    As the crews are alike there are no edges from crews to decisions.
    """
    types = tuple(f"type_{k}" for k in range(n_types))
    shares = tuple(f"type_{k}_share" for k in range(n_types))
    return GraphSpec(
        nodes=(NodeType("plane", _PLANE + types), NodeType("crew", _CREW)),
        state_features=_STATE + shares,
        relations=(
            Relation("crew", "repairing", "plane", "scatter", index="repairing"),
            Relation("plane", "repaired_by", "crew", "gather", index="repairing"),
            Relation("plane", "in", "state", "all", attention=True),
            Relation("crew", "in", "state", "all", attention=True),
            Relation("plane", "to", "decision", "same"),
            Relation("state", "to", "decision", "all"),
        ),
        decision_of="plane",
    )


def pressing(spec: GraphSpec, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Broken planes that a crew sees as they are and that nobody has in hand, bool (B, P + 1).

    `spec` is the metagraph that the observation is of; without the features `broken` and `age_hours` of planes nothing
    tells which planes these are, so none is pressing.

    Every plane has a home crew, which sees it as it is. If a crew does not idle while it could serve one of these, no
    plane stays broken for ever beside a crew with nothing to do.
    """
    legal, broken, age = observation["action_mask"] > 0, _PLANE[BROKEN], _PLANE[AGE]
    names = next((node.features for node in spec.nodes if node.name == "plane"), ())
    if broken not in names or age not in names:
        return np.zeros_like(legal)
    plane = observation["plane"]
    return (plane[..., names.index(broken)] > 0) & (plane[..., names.index(age)] == 0) & legal

"""A MuRSE state as the heterogeneous graph that one agent sees (dissertation, figures 4.3 and 5.2).

Task slot 0 is the placeholder s0, whose decision is to wait; slots 1..n are the tasks and slot n + 1 is f0, which
is never legal. Durations and times are divided by the instance's longest possible duration (`unit` below), times
count from now. The state node holds shares and means of what is visible.

Features that look ahead (latest start and after; marl_sched.envs.murse.lookahead) are of the tasks that nobody has
taken yet, and of the choices that the viewer has now:

    latest_start   from now, so that all behind the task can hold deadlines, undated ones a common horizon
    slack          latest start less earliest start
    tail           the longest chain of waits behind the task, everybody at their shortest
    is_due         a deadline bears on the task; time_to_spare: as slack, by deadlines alone
    regret         the viewer's earliest finish less the best of the other agents'
    reduced_cost   the viewer's price x duration less the least of all agents'
    rank/10        of the choice by the latest-start rule, 0 for the rule's own; rule_choice: it is that one
    breaks/10      deadlines that could still be held and could not after this choice; broken_time: by how much
    planned_start  in the rule's schedule of all that is in sight; planned_mine: it is the viewer's there

The edges between tasks come from the temporal network on starts (marl_sched.envs.murse.network) over the visible
tasks: `sparse` keeps its bounds and adds them reversed (relation `aug`, section 5.4.1), `distance` closes it to
the minimum distance graph (section 4.3.1). An edge's attribute is its bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.graph import GraphSpec, NodeType, Relation

SPARSE, DISTANCE = 0, 1
SIMPLIFICATIONS = ("sparse", "distance")

TASK_FEATURES = (
    "placeholder", "unscheduled", "committed", "finished", "mine", "eligible", "min_duration", "max_duration",
    "mean_duration", "std_duration", "my_duration", "my_spread", "my_repetitions/10", "has_deadline", "deadline",
    "earliest_start", "earliest_finish", "start", "finish", "weight/10", "waits_unheeded", "waited_for", "distance",
    "latest_start", "slack", "tail", "is_due", "time_to_spare", "regret", "reduced_cost", "rank/10", "rule_choice",
    "breaks/10", "broken_time", "planned_start", "planned_mine",
)  # fmt: skip
(
    PLACEHOLDER, UNSCHEDULED, COMMITTED, FINISHED, MINE, ELIGIBLE, MIN_DURATION, MAX_DURATION, MEAN_DURATION,
    STD_DURATION, MY_DURATION, MY_SPREAD, MY_REPETITIONS, HAS_DEADLINE, DEADLINE, EARLIEST_START, EARLIEST_FINISH,
    START, FINISH, WEIGHT, WAITS_UNHEEDED, WAITED_FOR, DISTANCE_TO, LATEST_START, SLACK, TAIL, IS_DUE, TIME_TO_SPARE,
    REGRET, REDUCED_COST, RANK, RULE_CHOICE, BREAKS, BROKEN_TIME, PLANNED_START, PLANNED_MINE,
) = range(len(TASK_FEATURES))  # fmt: skip
AGENT_FEATURES = ("robot", "human", "acting", "free", "free_at", "tasks_share", "distance", "price", "planned_finish")
LOCATION_FEATURES = ("tasks_share", "unscheduled_share", "committed_share")
STATE_FEATURES = (
    "unscheduled_share", "committed_share", "finished_share", "deadline_share", "mean_duration", "tasks_per_agent/10",
    "robot_share", "clock/10", "round/10", "planned_makespan", "planned_lateness",
)  # fmt: skip
PAIR_FEATURES = ("mean", "spread", "finish", "regret", "reduced_cost")
UNIT_OF_COUNTS = 10.0
N_TASK, N_AGENT = len(TASK_FEATURES), len(AGENT_FEATURES)
N_LOCATION, N_STATE = len(LOCATION_FEATURES), len(STATE_FEATURES)
N_PAIR = len(PAIR_FEATURES)


def graph_spec(simplification: int) -> GraphSpec:
    """The metagraph for SPARSE or DISTANCE edges between tasks."""
    reverse = (Relation("task", "aug", "task", "dense", attention=True, attributes=("bound",)),)
    return GraphSpec(
        nodes=(
            NodeType("task", TASK_FEATURES),
            NodeType("agent", AGENT_FEATURES),
            NodeType("location", LOCATION_FEATURES),
        ),
        state_features=STATE_FEATURES,
        relations=(
            Relation("task", "temporal", "task", "dense", attention=True, attributes=("bound",)),
            *(reverse if simplification == SPARSE else ()),
            Relation("task", "assigned_to", "agent", "scatter", attention=True, index="assigned_to"),
            Relation("task", "take_time", "agent", "dense", attention=True, attributes=PAIR_FEATURES),
            Relation("agent", "use_time", "task", "dense", attention=True, attributes=PAIR_FEATURES),
            Relation("agent", "communicate", "agent", "all", attention=True),
            Relation("task", "located_in", "location", "scatter", attention=True, index="located_in"),
            Relation("location", "hosts", "task", "gather", index="located_in"),
            Relation("location", "near", "location", "dense", attention=True),
            Relation("task", "in", "state", "all", attention=True),
            Relation("agent", "in", "state", "all", attention=True),
            Relation("location", "in", "state", "all", attention=True),
            Relation("task", "to", "decision", "same"),
            Relation("agent", "to", "decision", "gather", index="decider"),
            Relation("state", "to", "decision", "all"),
        ),
        decision_of="task",
    )


class Arrays(NamedTuple):
    """The arrays of an observation that the kernel writes; see marl_sched.graph. Those of `aug` may be empty."""

    task: np.ndarray
    task_mask: np.ndarray
    agent: np.ndarray
    agent_mask: np.ndarray
    location: np.ndarray
    location_mask: np.ndarray
    state: np.ndarray
    temporal: np.ndarray
    temporal_attributes: np.ndarray
    aug: np.ndarray
    aug_attributes: np.ndarray
    assigned_to: np.ndarray
    take_time: np.ndarray
    take_time_attributes: np.ndarray
    use_time: np.ndarray
    use_time_attributes: np.ndarray
    located_in: np.ndarray
    near: np.ndarray
    decider: np.ndarray
    action_mask: np.ndarray
    time: np.ndarray
    visible_share: np.ndarray

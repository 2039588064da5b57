"""A MuRSE state as the heterogeneous graph that one agent sees (dissertation, figures 4.3 and 5.2).

Task slot 0 is the placeholder s0, whose decision is to wait; slots 1..n are the tasks and slot n + 1 is f0, which
is never legal. Durations and times are divided by the instance's longest possible duration (`unit` below), times
count from now. The state node holds shares and means of what is visible.

The edges between tasks come from the temporal network on starts (marl_sched.envs.murse.network) over the visible
tasks: `sparse` keeps its bounds and adds them reversed (relation `aug`, section 5.4.1), `distance` closes it to
the minimum distance graph (section 4.3.1). An edge's attribute is its bound.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.network import simplified_network
from marl_sched.envs.murse.rules import Rules
from marl_sched.envs.murse.state import NEVER, NOBODY, State
from marl_sched.envs.murse.timetable import earliest_start
from marl_sched.envs.murse.views import Sight, look, standpoint
from marl_sched.graph import GraphSpec, NodeType, Relation
from marl_sched.temporal_network import UNBOUNDED, close

SPARSE, DISTANCE = 0, 1
SIMPLIFICATIONS = ("sparse", "distance")

TASK_FEATURES = (
    "placeholder", "unscheduled", "committed", "finished", "mine", "eligible", "min_duration", "max_duration",
    "mean_duration", "std_duration", "my_duration", "my_spread", "my_repetitions/10", "has_deadline", "deadline",
    "earliest_start", "earliest_finish", "start", "finish", "weight/10", "waits_unheeded", "waited_for", "distance",
)  # fmt: skip
(
    PLACEHOLDER, UNSCHEDULED, COMMITTED, FINISHED, MINE, ELIGIBLE, MIN_DURATION, MAX_DURATION, MEAN_DURATION,
    STD_DURATION, MY_DURATION, MY_SPREAD, MY_REPETITIONS, HAS_DEADLINE, DEADLINE, EARLIEST_START, EARLIEST_FINISH,
    START, FINISH, WEIGHT, WAITS_UNHEEDED, WAITED_FOR, DISTANCE_TO,
) = range(len(TASK_FEATURES))  # fmt: skip
AGENT_FEATURES = ("robot", "human", "acting", "free", "free_at", "tasks_share", "distance")
LOCATION_FEATURES = ("tasks_share", "unscheduled_share", "committed_share")
STATE_FEATURES = (
    "unscheduled_share", "committed_share", "finished_share", "deadline_share", "mean_duration", "tasks_per_agent/10",
    "robot_share", "clock/10", "round/10",
)  # fmt: skip


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
            Relation("task", "take_time", "agent", "dense", attention=True, attributes=("mean", "spread")),
            Relation("agent", "use_time", "task", "dense", attention=True, attributes=("mean", "spread")),
            Relation("agent", "communicate", "agent", "all", attention=True),
            Relation("task", "located_in", "location", "scatter", attention=True, index="located_in"),
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


@njit(cache=True)
def observe(state: State, rules: Rules, agents: np.ndarray, sensing: float, comm: float, out: Arrays) -> None:
    """Write what each row's agent, int64 (B,), sees; a negative agent sees nothing."""
    for b in range(len(agents)):
        clear(out, b)
        out.action_mask[b, 0] = 1
        out.time[b] = state.rows[b].time
        viewer = agents[b]
        if viewer < 0:
            continue
        sight = look(state, rules, b, viewer, sensing, comm)
        see_agents(state, b, viewer, sight, out)
        see_tasks(state, b, viewer, sight, out)
        see_durations(state, b, sight, out)
        see_locations(state, b, sight, out)
        see_network(state, b, sight, out)
        summarise(state, b, sight, out)
        if state.agents[b, viewer].free_at <= state.rows[b].clock and state.rows[b].acting != NOBODY:
            offer(state, b, sight, out)


@njit(cache=True)
def clear(out: Arrays, b: int) -> None:
    """Forget what a row held."""
    out.task[b] = 0.0
    out.task_mask[b] = 0
    out.agent[b] = 0.0
    out.agent_mask[b] = 0
    out.location[b] = 0.0
    out.location_mask[b] = 0
    out.state[b] = 0.0
    out.temporal[b] = 0
    out.temporal_attributes[b] = 0.0
    if len(out.aug) > 0:
        out.aug[b] = 0
        out.aug_attributes[b] = 0.0
    out.assigned_to[b] = -1
    out.take_time[b] = 0
    out.take_time_attributes[b] = 0.0
    out.use_time[b] = 0
    out.use_time_attributes[b] = 0.0
    out.located_in[b] = -1
    out.near[b] = 0
    out.decider[b] = -1
    out.action_mask[b] = 0
    out.visible_share[b] = 0.0


@njit(cache=True)
def see_agents(state: State, b: int, viewer: int, sight: Sight, out: Arrays) -> None:
    """Agents within hearing, when they will be free and how many tasks they have."""
    row = state.rows[b]
    x, y = standpoint(state, b, viewer)
    for agent in range(row.n_agents):
        if not sight.heard[agent]:
            continue
        features, place = out.agent[b, agent], standpoint(state, b, agent)
        out.agent_mask[b, agent] = 1
        features[0] = agent < row.n_robots
        features[1] = agent >= row.n_robots
        features[2] = agent == viewer
        last = state.agents[b, agent].last_task
        busy_until = sight.finish[last] if last >= 0 else 0
        features[3] = busy_until <= row.clock
        features[4] = max(busy_until - row.clock, 0) / row.high
        features[6] = np.hypot(place[0] - x, place[1] - y) / 10
    for task in range(row.n_tasks):
        if sight.known[task] and sight.heard[state.tasks[b, task].agent]:
            out.agent[b, state.tasks[b, task].agent, 5] += 1 / row.n_tasks


@njit(cache=True)
def see_tasks(state: State, b: int, viewer: int, sight: Sight, out: Arrays) -> None:
    """The placeholders and the tasks in sight, each as the viewer knows it."""
    row = state.rows[b]
    for slot in (0, row.n_tasks + 1):
        out.task[b, slot, PLACEHOLDER] = 1.0
        out.task_mask[b, slot] = 1
    visible = 0
    for task in range(row.n_tasks):
        if sight.seen[task]:
            visible += 1
            out.task_mask[b, task + 1] = 1
            describe(state, b, viewer, task, sight, out.task[b, task + 1])
            if sight.known[task] and sight.heard[state.tasks[b, task].agent]:
                out.assigned_to[b, task + 1] = state.tasks[b, task].agent
    out.visible_share[b] = visible / row.n_tasks


@njit(cache=True)
def describe(state: State, b: int, viewer: int, task: int, sight: Sight, features: np.ndarray) -> None:
    """A task's features."""
    row, job, pair = state.rows[b], state.tasks[b, task], state.pairs[b, task, viewer]
    unit, now = float(row.high), row.clock
    x, y = standpoint(state, b, viewer)
    features[DISTANCE_TO] = np.hypot(job.x - x, job.y - y) / 10
    features[WEIGHT] = job.weight / 10
    if job.deadline != NO_DEADLINE:
        features[HAS_DEADLINE] = 1.0
        features[DEADLINE] = (job.deadline - now) / unit
    describe_durations(state, b, task, sight, features)
    features[ELIGIBLE] = pair.true > 0
    features[MY_DURATION] = pair.mean / unit
    features[MY_SPREAD] = pair.spread / unit
    features[MY_REPETITIONS] = pair.repetitions / 10
    for other in range(row.n_tasks):
        heeded = sight.known[other] and sight.seen[other]
        features[WAITS_UNHEEDED] += state.lags[b, task, other] >= 0 and not heeded
        features[WAITED_FOR] += sight.seen[other] and state.lags[b, other, task] >= 0
    if sight.known[task]:
        finished = sight.finish[task] <= now
        features[FINISHED] = finished
        features[COMMITTED] = not finished
        features[MINE] = job.agent == viewer
        features[START] = (sight.start[task] - now) / unit
        features[FINISH] = (sight.finish[task] - now) / unit
    else:
        features[UNSCHEDULED] = 1.0
        earliest = believed_start(state, b, task, sight)
        features[EARLIEST_START] = (earliest - now) / unit
        features[EARLIEST_FINISH] = (earliest + pair.planned - now) / unit if pair.true > 0 else 0.0


@njit(cache=True)
def believed_start(state: State, b: int, task: int, sight: Sight) -> int:
    """When the viewer could start a task if it committed now, heeding the tasks that it sees to be taken."""
    row = state.rows[b]
    order, count = np.empty(row.n_tasks, np.int64), 0
    for k in range(row.dispatched):
        other = state.order[b, k]
        if sight.known[other] and sight.seen[other]:
            order[count] = other
            count += 1
    return earliest_start(task, row.clock, order, count, state.lags[b], state.near[b], sight.finish)


@njit(cache=True)
def describe_durations(state: State, b: int, task: int, sight: Sight, features: np.ndarray) -> None:
    """Estimated durations of a task over the eligible agents within hearing (section 4.3.1)."""
    row = state.rows[b]
    count, total, squares, least, most = 0, 0.0, 0.0, np.inf, 0.0
    for agent in range(row.n_agents):
        mean = state.pairs[b, task, agent].mean / row.high
        if sight.heard[agent] and mean > 0:
            count += 1
            total += mean
            squares += mean * mean
            least, most = min(least, mean), max(most, mean)
    if count > 0:
        features[MIN_DURATION] = least
        features[MAX_DURATION] = most
        features[MEAN_DURATION] = total / count
        features[STD_DURATION] = np.sqrt(max(squares / count - (total / count) ** 2, 0.0))


@njit(cache=True)
def see_durations(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """Edges between unscheduled tasks and eligible agents, with estimate and spread, both ways."""
    row = state.rows[b]
    for task in range(row.n_tasks):
        if not sight.seen[task] or sight.known[task]:
            continue
        for agent in range(row.n_agents):
            pair = state.pairs[b, task, agent]
            if sight.heard[agent] and pair.true > 0:
                mean, spread = pair.mean / row.high, pair.spread / row.high
                out.take_time[b, agent, task + 1] = 1
                out.take_time_attributes[b, agent, task + 1, 0] = mean
                out.take_time_attributes[b, agent, task + 1, 1] = spread
                out.use_time[b, task + 1, agent] = 1
                out.use_time_attributes[b, task + 1, agent, 0] = mean
                out.use_time_attributes[b, task + 1, agent, 1] = spread


@njit(cache=True)
def see_locations(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """Locations of tasks in sight, and which of them lie too close for work at the same time."""
    row = state.rows[b]
    for task in range(row.n_tasks):
        if not sight.seen[task]:
            continue
        place = state.tasks[b, task].place
        out.located_in[b, task + 1] = place
        out.location_mask[b, place] = 1
        out.location[b, place, 0] += 1 / row.n_tasks
        out.location[b, place, 1] += out.task[b, task + 1, UNSCHEDULED] / row.n_tasks
        out.location[b, place, 2] += out.task[b, task + 1, COMMITTED] / row.n_tasks
        for other in range(row.n_tasks):
            if sight.seen[other] and state.near[b, task, other]:
                out.near[b, place, state.tasks[b, other].place] = 1


@njit(cache=True)
def see_network(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """Edges of the temporal network over the tasks in sight, those taken in their agents' order."""
    row = state.rows[b]
    slots, count = np.empty(row.n_tasks, np.int64), 0
    for task in range(row.n_tasks):
        if sight.seen[task]:
            slots[count] = task
            count += 1
    durations, deadlines, lags, horizon = visible_problem(state, b, sight, slots[:count])
    distances = simplified_network(durations, lags, deadlines, horizon)
    sparse = len(out.aug) > 0
    if not sparse:
        close(distances)
    for u in range(count + 2):
        source = 0 if u == 0 else row.n_tasks + 1 if u > count else slots[u - 1] + 1
        for v in range(count + 2):
            bound = distances[u, v]
            if u == v or bound >= UNBOUNDED:
                continue
            target = 0 if v == 0 else row.n_tasks + 1 if v > count else slots[v - 1] + 1
            out.temporal[b, target, source] = 1
            out.temporal_attributes[b, target, source, 0] = bound / row.high
            if sparse:
                out.aug[b, source, target] = 1
                out.aug_attributes[b, source, target, 0] = bound / row.high


@njit(cache=True)
def visible_problem(
    state: State, b: int, sight: Sight, slots: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Durations, deadlines, lags and horizon of the tasks in sight, int64 (k,) `slots`, as the viewer knows them.

    An unscheduled task counts with the shortest estimate of those within hearing. The order of an agent's tasks
    is a wait of 0.
    """
    row, k = state.rows[b], len(slots)
    durations, deadlines = np.zeros(k, np.int64), np.zeros(k, np.int64)
    lags, horizon = np.full((k, k), -1, np.int64), 0
    for i in range(k):
        task = slots[i]
        deadlines[i] = state.tasks[b, task].deadline
        least, most = NEVER, 0
        for agent in range(row.n_agents):
            planned = state.pairs[b, task, agent].planned
            if sight.heard[agent] and planned > 0:
                least, most = min(least, planned), max(most, planned)
        durations[i] = sight.finish[task] - sight.start[task] if sight.known[task] else (least if most > 0 else 0)
        horizon += max(most, durations[i])
        for j in range(k):
            other = slots[j]
            lags[i, j] = state.lags[b, task, other]
            horizon += max(lags[i, j], 0)
            if sight.known[task] and sight.known[other] and i != j and lags[i, j] < 0:
                same = state.tasks[b, task].agent == state.tasks[b, other].agent
                if same and sight.finish[other] <= sight.start[task]:
                    lags[i, j] = 0
    return durations, deadlines, lags, horizon


@njit(cache=True)
def offer(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """The targets that are legal as far as the viewer knows: free, eligible, and behind all that they wait for."""
    for slot in range(1, state.rows[b].n_tasks + 1):
        features = out.task[b, slot]
        free = features[UNSCHEDULED] == 1.0 and features[ELIGIBLE] == 1.0
        if out.task_mask[b, slot] == 1 and free and features[WAITS_UNHEEDED] == 0.0:
            out.action_mask[b, slot] = 1


@njit(cache=True)
def summarise(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """The state node's features and the edges from the viewer to its decisions, from visible nodes alone."""
    row, features = state.rows[b], out.state[b]
    tasks = heard = 0
    for agent in range(row.n_agents):
        if sight.heard[agent]:
            heard += 1
            features[6] += agent < row.n_robots
            if out.agent[b, agent, 2] == 1.0:
                for slot in range(row.n_tasks + 1):
                    out.decider[b, slot] = agent if out.task_mask[b, slot] == 1 else -1
    for slot in range(1, row.n_tasks + 1):
        if out.task_mask[b, slot] == 1:
            tasks += 1
            features[0] += out.task[b, slot, UNSCHEDULED]
            features[1] += out.task[b, slot, COMMITTED]
            features[2] += out.task[b, slot, FINISHED]
            features[3] += out.task[b, slot, HAS_DEADLINE]
            features[4] += out.task[b, slot, MEAN_DURATION]
    for k in range(5):
        features[k] /= max(tasks, 1)
    features[5] = tasks / heard / 10
    features[6] /= heard
    features[7] = row.clock / row.high / 10
    features[8] = row.round / 10

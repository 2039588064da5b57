"""Writing what an agent sees of a MuRSE state into the arrays of its graph (marl_sched.envs.murse.graph)."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.dynamics import Record
from marl_sched.envs.murse.graph import (
    COMMITTED,
    DEADLINE,
    DISTANCE_TO,
    EARLIEST_FINISH,
    EARLIEST_START,
    ELIGIBLE,
    FINISH,
    FINISHED,
    HAS_DEADLINE,
    MAX_DURATION,
    MEAN_DURATION,
    MIN_DURATION,
    MINE,
    MY_DURATION,
    MY_REPETITIONS,
    MY_SPREAD,
    N_AGENT,
    N_LOCATION,
    N_PAIR,
    N_STATE,
    N_TASK,
    PLACEHOLDER,
    START,
    STD_DURATION,
    UNSCHEDULED,
    WAITED_FOR,
    WAITS_UNHEEDED,
    WEIGHT,
    Arrays,
)
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.lookahead import Outlook, new_outlook, see_ahead
from marl_sched.envs.murse.network import network_of, simplified_bounds
from marl_sched.envs.murse.rules import Rules
from marl_sched.envs.murse.state import NEVER, NOBODY, State
from marl_sched.envs.murse.timetable import earliest_start
from marl_sched.envs.murse.views import Sight, new_sight, standpoint, survey
from marl_sched.errors import InvalidOptionError
from marl_sched.kernels import kernel
from marl_sched.temporal_network import UNBOUNDED, close


@kernel(error_model="numpy")
def observe(state: State, rules: Rules, agents: np.ndarray, sensing: float, comm: float, out: Arrays) -> None:
    """Write what each row's agent, int64 (B,), sees; a negative agent sees nothing."""
    require_fitting(state, agents, out)
    sight, outlook = new_sight(state), new_outlook(state)
    for b in range(len(agents)):
        clear(out, b)
        out.action_mask[b, 0] = 1
        out.time[b] = state.rows[b].time
        viewer = agents[b]
        if viewer < 0:
            continue
        survey(state, rules, b, viewer, sensing, comm, sight)
        describe(state, b, viewer, sight, outlook, out)


@kernel(error_model="numpy")
def observe_known(state: State, viewer: int, sight: Sight, out: Arrays) -> None:
    """Write what an agent sees that was told `sight` of the only row, as `observe` writes what it surveys by itself."""
    for b in range(len(out.time)):  # not a literal 0, for which everything would be compiled again
        clear(out, b)
        out.action_mask[b, 0] = 1
        out.time[b] = state.rows[b].time
        describe(state, b, viewer, sight, new_outlook(state), out)


@kernel(error_model="numpy")
def describe(state: State, b: int, viewer: int, sight: Sight, outlook: Outlook, out: Arrays) -> None:
    """Write what a viewer knows into row b, which has been cleared."""
    see_agents(state, b, viewer, sight, out)
    startable = see_tasks(state, b, viewer, sight, out)
    see_durations(state, b, sight, out)
    see_locations(state, b, sight, out)
    see_network(state, b, sight, out)
    summarise(state, b, sight, out)
    if state.agents[b, viewer].free_at <= state.rows[b].clock and state.rows[b].acting != NOBODY:
        write_action_mask(startable, b, out)
    see_ahead(state, b, viewer, sight, outlook, out)


@kernel
def require_fitting(state: State, agents: np.ndarray, out: Arrays) -> None:
    """Raise InvalidOptionError where arrays or agents do not fit: compiled code does not check its indices."""
    batch, n, m = len(agents), state.tasks.shape[1], state.agents.shape[1]
    tasks, edges = (batch, n + 2), (batch, n + 2, n + 2)
    fit = state.rows.shape[0] == batch and out.agent.shape == (batch, m, N_AGENT) and out.agent_mask.shape == (batch, m)
    fit &= out.task.shape == (batch, n + 2, N_TASK) and out.task_mask.shape == out.action_mask.shape == tasks
    fit &= out.assigned_to.shape == out.located_in.shape == out.decider.shape == tasks
    fit &= out.location.shape == (batch, n, N_LOCATION) and out.location_mask.shape == (batch, n)
    fit &= out.near.shape == (batch, n, n) and out.state.shape == (batch, N_STATE)
    fit &= out.temporal.shape == edges and out.temporal_attributes.shape == (batch, n + 2, n + 2, 1)
    fit &= len(out.aug) == 0 or (out.aug.shape == edges and out.aug_attributes.shape == out.temporal_attributes.shape)
    fit &= out.take_time.shape == (batch, m, n + 2) and out.take_time_attributes.shape == (batch, m, n + 2, N_PAIR)
    fit &= out.use_time.shape == (batch, n + 2, m) and out.use_time_attributes.shape == (batch, n + 2, m, N_PAIR)
    if not fit or out.time.shape != (batch,) or out.visible_share.shape != (batch,):
        raise InvalidOptionError("out: expected arrays of the shapes that new_observation() makes")
    for b in range(batch):
        if agents[b] >= m:
            raise InvalidOptionError("agents: expected agents below max_agents")


@kernel(error_model="numpy")
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


@kernel(error_model="numpy")
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


@kernel(error_model="numpy")
def see_tasks(state: State, b: int, viewer: int, sight: Sight, out: Arrays) -> np.ndarray:
    """The placeholders and the tasks in sight, each as the viewer knows it.

    Returns bool (n,): the tasks that the viewer could start as far as it knows, those in sight that nobody has taken,
    that it is eligible for, and all of whose predecessors are taken.
    """
    row, tasks, lags, near = state.rows[b], state.tasks[b], state.lags[b], state.near[b]
    n, m = row.n_tasks, row.n_agents
    x, y = standpoint(state, b, viewer)
    for slot in (0, n + 1):
        out.task[b, slot, PLACEHOLDER] = 1.0
        out.task_mask[b, slot] = 1
    taken, count = np.empty(n, np.int64), 0
    for k in range(row.dispatched):
        other = state.order[b, k]
        if sight.known[other] and sight.seen[other]:
            taken[count] = other
            count += 1
    visible, startable = 0, np.zeros(n, np.bool_)
    for task in range(n):
        if not sight.seen[task]:
            continue
        visible += 1
        features, job, pairs = out.task[b, task + 1], tasks[task], state.pairs[b, task, :m]
        out.task_mask[b, task + 1] = 1
        describe_task(features, job, row.high, row.clock, x, y)
        describe_durations(features, pairs, viewer, sight.heard, row.high)
        unheeded = describe_waits(out.task[b], task, lags, taken[:count], sight.seen[:n])
        startable[task] = not sight.known[task] and pairs[viewer].true >= 0 and unheeded == 0
        if sight.known[task]:
            describe_commitment(features, sight.start[task] - row.clock, sight.finish[task] - row.clock, row.high)
            features[MINE] = job.agent == viewer
            if sight.heard[job.agent]:
                out.assigned_to[b, task + 1] = job.agent
        else:
            earliest = earliest_start(task, row.clock, taken, count, lags, near, sight.finish) - row.clock
            features[UNSCHEDULED] = 1.0
            features[EARLIEST_START] = earliest / row.high
            if pairs[viewer].true >= 0:
                features[EARLIEST_FINISH] = (earliest + pairs[viewer].planned) / row.high
    out.visible_share[b] = visible / n
    return startable


@kernel(error_model="numpy")
def describe_task(features: np.ndarray, job: Record, unit: int, now: int, x: float, y: float) -> None:
    """What a task is: its weight, its deadline from now, and how far it lies from (x, y)."""
    features[DISTANCE_TO] = np.hypot(job.x - x, job.y - y) / 10
    features[WEIGHT] = job.weight / 10
    if job.deadline != NO_DEADLINE:
        features[HAS_DEADLINE] = 1.0
        features[DEADLINE] = (job.deadline - now) / unit


@kernel(error_model="numpy")
def describe_durations(features: np.ndarray, pairs: np.ndarray, viewer: int, heard: np.ndarray, unit: int) -> None:
    """Estimates for the viewer, and their statistics over the eligible agents within hearing (section 4.3.1)."""
    own = pairs[viewer]
    features[ELIGIBLE] = own.true >= 0
    features[MY_DURATION] = own.mean / unit
    features[MY_SPREAD] = own.spread / unit
    features[MY_REPETITIONS] = own.repetitions / 10
    count, total, squares, least, most = 0, 0.0, 0.0, np.inf, 0.0
    for agent in range(len(pairs)):
        mean = pairs[agent].mean / unit
        if heard[agent] and mean > 0:
            count += 1
            total += mean
            squares += mean * mean
            least, most = min(least, mean), max(most, mean)
    if count > 0:
        features[MIN_DURATION] = least
        features[MAX_DURATION] = most
        features[MEAN_DURATION] = total / count
        features[STD_DURATION] = np.sqrt(max(squares / count - (total / count) ** 2, 0.0))


@kernel(error_model="numpy")
def describe_waits(features: np.ndarray, task: int, lags: np.ndarray, taken: np.ndarray, seen: np.ndarray) -> int:
    """For how many tasks that are not in `taken`, int64 (k,), a task in sight waits; told in float32 (slots, F) too.

    Those in sight, bool (n,), that it waits for are told that one more waits for them.
    """
    unheeded = 0
    for other in range(len(seen)):
        if lags[task, other] >= 0:
            unheeded += 1
            if seen[other]:
                features[other + 1, WAITED_FOR] += 1.0
    for other in taken:
        unheeded -= lags[task, other] >= 0
    features[task + 1, WAITS_UNHEEDED] = unheeded
    return unheeded


@kernel(error_model="numpy")
def describe_commitment(features: np.ndarray, start: int, finish: int, unit: int) -> None:
    """A taken task's believed times from now."""
    features[FINISHED] = finish <= 0
    features[COMMITTED] = finish > 0
    features[START] = start / unit
    features[FINISH] = finish / unit


@kernel(error_model="numpy")
def see_durations(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """Edges between unscheduled tasks and eligible agents, with estimate and spread, both ways."""
    row = state.rows[b]
    for task in range(row.n_tasks):
        if not sight.seen[task] or sight.known[task]:
            continue
        for agent in range(row.n_agents):
            pair = state.pairs[b, task, agent]
            if sight.heard[agent] and pair.true >= 0:
                mean, spread = pair.mean / row.high, pair.spread / row.high
                out.take_time[b, agent, task + 1] = 1
                out.take_time_attributes[b, agent, task + 1, 0] = mean
                out.take_time_attributes[b, agent, task + 1, 1] = spread
                out.use_time[b, task + 1, agent] = 1
                out.use_time_attributes[b, task + 1, agent, 0] = mean
                out.use_time_attributes[b, task + 1, agent, 1] = spread


@kernel(error_model="numpy")
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


@kernel(error_model="numpy")
def see_network(state: State, b: int, sight: Sight, out: Arrays) -> None:
    """Edges of the temporal network over the tasks in sight, those taken in their agents' order."""
    row = state.rows[b]
    n, m, unit = row.n_tasks, row.n_agents, row.high
    seen, count = np.empty(n, np.int64), 0
    for task in range(n):
        if sight.seen[task]:
            seen[count] = task
            count += 1
    bounds = visible_bounds(seen[:count], state.tasks[b], state.pairs[b, :n, :m], state.lags[b], sight)
    slots = np.zeros(count + 2, np.int64)
    slots[1 : count + 1] = seen[:count] + 1
    slots[count + 1] = n + 1
    if len(out.aug) > 0:
        for k in range(len(bounds)):
            source, target, bound = slots[bounds[k, 0]], slots[bounds[k, 1]], bounds[k, 2] / unit
            out.temporal[b, target, source] = out.aug[b, source, target] = 1
            out.temporal_attributes[b, target, source, 0] = out.aug_attributes[b, source, target, 0] = bound
        return
    distances = network_of(bounds, count + 2)
    close(distances)
    for u in range(count + 2):
        for v in range(count + 2):
            if u != v and distances[u, v] < UNBOUNDED:
                out.temporal[b, slots[v], slots[u]] = 1
                out.temporal_attributes[b, slots[v], slots[u], 0] = distances[u, v] / unit


@kernel(error_model="numpy")
def visible_bounds(
    seen: np.ndarray, tasks: np.ndarray, pairs: np.ndarray, lags: np.ndarray, sight: Sight
) -> np.ndarray:
    """The bounds between the tasks in sight, int64 (k,) `seen`, as the viewer knows them; see simplified_bounds.

    tasks TASK (N,), pairs PAIR (N, A), lags int64 (N, N). An unscheduled task counts with the shortest estimate of
    those within hearing. The order of an agent's tasks is a wait of 0.
    """
    k = len(seen)
    durations, deadlines, owners = np.zeros(k, np.int64), np.zeros(k, np.int64), np.full(k, NOBODY, np.int64)
    inner, horizon = np.full((k, k), -1, np.int64), 0
    for i in range(k):
        task = seen[i]
        deadlines[i] = tasks[task].deadline
        least, most = NEVER, 0
        for agent in range(pairs.shape[1]):
            planned = pairs[task, agent].planned
            if sight.heard[agent] and planned >= 0:
                least, most = min(least, planned), max(most, planned)
        durations[i] = least if least < NEVER else 0
        if sight.known[task]:
            durations[i] = sight.finish[task] - sight.start[task]
            owners[i] = tasks[task].agent
        horizon += max(most, durations[i])
    for i in range(k):
        for j in range(k):
            lag = lags[seen[i], seen[j]]
            if lag >= 0:
                inner[i, j] = lag
                horizon += lag
            elif i != j and owners[i] != NOBODY and owners[i] == owners[j]:
                inner[i, j] = 0 if sight.finish[seen[j]] <= sight.start[seen[i]] else -1
    return simplified_bounds(durations, inner, deadlines, horizon)


@kernel(error_model="numpy")
def write_action_mask(startable: np.ndarray, b: int, out: Arrays) -> None:
    """The actions that are legal as far as the viewer knows, from what `see_tasks` says it could start, bool (n,)."""
    for task in range(len(startable)):
        if startable[task]:
            out.action_mask[b, task + 1] = 1


@kernel(error_model="numpy")
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

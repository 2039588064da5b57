"""The MuRSE simulator as compiled kernels (dissertation, sections 3.4.1, 4.2.2 and 5.2).

A round is built by agents that commit to tasks one at a time. The agent that is free earliest decides next;
among several the picking strategy chooses. In `online` mode a committed task runs with its true duration and
the agent decides again when it is really done. In `plan` mode the same happens on estimated durations, and when
every task has an agent the plan is executed with the true ones: each agent keeps its order, near tasks keep the
order of dispatch, everything starts as early as that allows.

A task can be dispatched once all tasks that it waits for have been (`dispatchable`): only then is its start
defined, and since something that can be dispatched always remains, a team gets stuck only by waiting. The task
need not be able to start at once; its agent then idles until it can.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_sched.envs.murse.estimator import predict, update
from marl_sched.envs.murse.learning import drawn_duration, mean_duration, whole
from marl_sched.envs.murse.rules import DECISION_REWARD, FIRST, LEAST_LEFT, MEAN_ALL, ONLINE, Rules
from marl_sched.envs.murse.scoring import cost_so_far, evaluate_round, round_cost
from marl_sched.envs.murse.state import NEVER, NOBODY, NOT_WAITING, NOTHING, State
from marl_sched.envs.murse.timetable import earliest_start, longest_round, time_order, waits_heeded
from marl_sched.kernels import kernel
from marl_sched.noise import time_key

Record = Any  # one element of a record array, whose fields compiled code reads as attributes

WAIT = 0
IDLE_AFTER_CONFLICT = 1
MAX_HUMANS = 1 << 12


@kernel
def begin_episode(state: State, rules: Rules, b: int) -> None:
    """Row b starts its first round, with `episode` and the instance's data in place."""
    row = state.rows[b]
    row.round = 0
    row.origin = 0
    row.elapsed = 0
    row.reward = 0.0
    row.conflict = False
    row.terminated = False
    state.pairs[b].repetitions[:] = 0
    state.rounds[b].feasible[:] = False
    state.executed[b].agent[:] = NOBODY
    if row.stochastic:
        for task in range(row.n_tasks):
            for agent in range(row.n_robots, row.n_agents):
                state.filters[b, task, agent] = state.priors[b]
    begin_round(state, rules, b)


@kernel
def begin_round(state: State, rules: Rules, b: int) -> None:
    """Draw the round's durations and estimates, forget the last round's schedule, and let the first agent decide."""
    row, tasks, agents = state.rows[b], state.tasks[b], state.agents[b]
    row.clock = 0
    row.time = row.origin
    row.dispatched = 0
    row.conflicts = 0
    row.paid = 0.0
    tasks.agent[:] = NOBODY
    tasks.start[:] = 0
    tasks.finish[:] = 0
    agents.free_at[:] = 0
    agents.waiting_since[:] = NOT_WAITING
    agents.last_task[:] = NOTHING
    state.private_memory[b] = -1
    draw_durations(state, b)
    n, m = row.n_tasks, row.n_agents
    pairs = state.pairs[b, :n, :m]
    row.limit = longest_round(pairs.true if rules.mode == ONLINE else pairs.planned, state.lags[b, :n, :n])
    row.acting = pick_agent(state, rules, b)


@kernel
def draw_durations(state: State, b: int) -> None:
    """True durations of this round, one draw per task and human, and what the team expects of them."""
    row = state.rows[b]
    time_word = time_key(row.episode, row.round)
    for task in range(row.n_tasks):
        for agent in range(row.n_agents):
            pair, base = state.pairs[b, task, agent], state.base[b, task, agent]
            pair.true = base
            pair.spread = 0.0
            if agent >= row.n_robots and base >= 0:
                curve = state.curves[b, task, agent]
                if row.stochastic:
                    entity = task * MAX_HUMANS + agent - row.n_robots
                    drawn = drawn_duration(curve, pair.repetitions, row.learning, time_word, entity)
                    expected, pair.spread = predict(state.filters[b, task, agent], pair.repetitions, row.learning)
                    pair.true = whole(drawn, row.low, row.high)
                    pair.planned = whole(expected, row.low, row.high)
                    pair.mean = min(max(expected, row.low), row.high)
                    continue
                pair.true = whole(mean_duration(curve, pair.repetitions, row.learning), row.low, row.high)
            pair.planned = pair.true
            pair.mean = max(pair.true, 0)


@kernel
def pick_agent(state: State, rules: Rules, b: int) -> int:
    """Who decides next: of the agents that are free earliest the one the strategy prefers (section 4.2.2).

    Sets the row's clock. NOBODY if all wait for something that will not happen, or if the clock would pass the
    longest round.
    """
    row, agents = state.rows[b], state.agents[b]
    earliest = agents.free_at[: row.n_agents].min()
    if earliest >= NEVER or earliest > row.limit:
        return NOBODY
    row.clock = earliest
    row.time = row.origin + earliest
    best, least = NOBODY, np.inf
    for agent in range(row.n_agents):
        if agents[agent].free_at == earliest:
            key = preference(state, rules.picking, b, agent)
            if best == NOBODY or key < least:
                best, least = agent, key
    return best


@kernel
def preference(state: State, picking: int, b: int, agent: int) -> float:
    """What a picking strategy minimises, on estimated durations; ties go to the lower index."""
    if picking == FIRST:
        return 0.0
    count, total, least = 0, 0.0, np.inf
    for task in range(state.rows[b].n_tasks):
        pair = state.pairs[b, task, agent]
        if pair.true >= 0 and (picking == MEAN_ALL or state.tasks[b, task].agent == NOBODY):
            count += 1
            total += pair.mean
            least = min(least, pair.mean)
    if picking == LEAST_LEFT or count == 0:
        return least
    return total / count


@kernel
def dispatchable(state: State, b: int, task: int, agent: int) -> bool:
    """Whether `agent` can commit to `task` now: unscheduled, eligible, and behind all that it waits for."""
    row = state.rows[b]
    if task < 0 or task >= row.n_tasks or state.tasks[b, task].agent != NOBODY or state.base[b, task, agent] < 0:
        return False
    return waits_heeded(task, row.n_tasks, state.order[b], row.dispatched, state.lags[b])


@kernel
def dispatch(state: State, rules: Rules, b: int, task: int, agent: int) -> None:
    """Append a task to the acting agent's schedule; agents that wait for a commitment wake."""
    row, agents, job = state.rows[b], state.agents[b], state.tasks[b, task]
    pair = state.pairs[b, task, agent]
    duration = pair.true if rules.mode == ONLINE else pair.planned
    job.start = earliest_start(
        task, row.clock, state.order[b], row.dispatched, state.lags[b], state.near[b], state.tasks[b].finish
    )
    job.finish = job.start + duration
    job.agent = agent
    job.committed = row.clock
    state.order[b, row.dispatched] = task
    row.dispatched += 1
    agents[agent].free_at = job.finish
    agents[agent].last_task = task
    for other in range(row.n_agents):
        if agents[other].waiting_since != NOT_WAITING:
            wakes = max(row.clock, agents[other].waiting_since + 1)
            agents[other].free_at = min(agents[other].free_at, wakes)


@kernel
def wait(state: State, b: int, agent: int) -> None:
    """Let the agent decide again when a task ends or a wait elapses, at least one unit on; `dispatch` may wake it."""
    row, tasks = state.rows[b], state.tasks[b]
    wakes = NEVER
    for k in range(row.dispatched):
        done = state.order[b, k]
        finish = tasks[done].finish
        if finish > row.clock:
            wakes = min(wakes, finish)
        for task in range(row.n_tasks):
            lag = state.lags[b, task, done]
            if lag > 0 and finish + lag > row.clock:
                wakes = min(wakes, finish + lag)
    state.agents[b, agent].free_at = wakes
    state.agents[b, agent].waiting_since = row.clock


@kernel
def decide(state: State, rules: Rules, b: int, action: int) -> None:
    """The acting agent waits, commits to task `action - 1`, or idles a unit because that is impossible in truth."""
    row, agent = state.rows[b], state.rows[b].acting
    state.agents[b, agent].waiting_since = NOT_WAITING
    if action == WAIT:
        wait(state, b, agent)
    elif dispatchable(state, b, action - 1, agent):
        before = cost_so_far(state, rules, b)
        dispatch(state, rules, b, action - 1, agent)
        if rules.rewards == DECISION_REWARD and row.dispatched < row.n_tasks:
            row.reward = (before - cost_so_far(state, rules, b)) / rules.divisor
    else:
        row.conflict = True
        row.conflicts += 1
        state.agents[b, agent].free_at = row.clock + IDLE_AFTER_CONFLICT
        if action <= row.n_tasks and state.tasks[b, action - 1].agent != NOBODY:
            tell(state, rules, b, action - 1, agent)


@kernel
def tell(state: State, rules: Rules, b: int, task: int, agent: int) -> None:
    """An agent that came to a taken task learns when it starts and ends, as far as its worker can tell now."""
    job, now, told = state.tasks[b, task], state.rows[b].clock, state.private_memory[b, agent, task]
    told[0], told[1] = job.start, job.finish
    if rules.mode == ONLINE and job.finish > now:
        told[0] = min(job.start, now)
        told[1] = max(told[0] + state.pairs[b, task, job.agent].planned, now + 1)


@kernel
def execute_plan(state: State, b: int) -> bool:
    """Give the dispatched tasks their true times: the earliest that keep each agent's and the dispatch order.

    False if a given schedule cannot be timed, because tasks in it must precede each other.
    """
    row, tasks = state.rows[b], state.tasks[b]
    n, m, order = row.n_tasks, row.n_agents, state.order[b, : row.dispatched]
    return time_order(
        order, tasks.agent[order], state.pairs[b, :n, :m].true, state.lags[b], state.near[b], tasks.start, tasks.finish
    )


@kernel
def learn(state: State, b: int) -> None:
    """Finished tasks count as repetitions of their humans, and the team's estimates take them in."""
    row = state.rows[b]
    for k in range(row.dispatched):
        task = state.order[b, k]
        agent = state.tasks[b, task].agent
        pair = state.pairs[b, task, agent]
        if agent >= row.n_robots:
            if row.stochastic:
                update(state.filters[b, task, agent], pair.repetitions, row.learning, float(pair.true))
            pair.repetitions += 1


@kernel
def end_round(state: State, rules: Rules, b: int) -> None:
    """Execute, evaluate and pay the round, then begin the next one or end the episode."""
    row = state.rows[b]
    planned = state.tasks[b].finish.max()
    consistent = rules.mode == ONLINE or execute_plan(state, b)
    evaluate_round(state, b, consistent)
    result, spent = state.rounds[b, row.round], -row.paid
    if rules.rewards == DECISION_REWARD and result.feasible:
        spent *= rules.divisor  # section 3.4.1 divides all changes but the last
    row.reward -= round_cost(state, rules, b) - spent
    learn(state, b)
    # Time never runs backwards: a plan may have looked further ahead than its execution took.
    row.origin += max(result.makespan, planned, row.clock + 1)
    row.round += 1
    if row.round < row.n_rounds:
        begin_round(state, rules, b)
    else:
        row.time = row.origin
        row.acting = NOBODY
        row.terminated = True


@kernel
def require_consistent(state: State, batch: int) -> None:
    """Raise ValueError where arrays do not belong together or a row does not fit into them: writing would go astray.

    Compiled code does not check its indices, so every entry point that writes begins with this.
    """
    n, m, rounds = state.tasks.shape[1], state.agents.shape[1], state.rounds.shape[1]
    fit = state.rows.shape[0] == state.tasks.shape[0] == state.agents.shape[0] == state.priors.shape[0] == batch
    fit &= state.pairs.shape == state.base.shape == state.filters.shape == (batch, n, m)
    fit &= state.curves.shape == (batch, n, m, 6) and state.order.shape == (batch, n)
    fit &= state.lags.shape == state.near.shape == (batch, n, n) and state.private_memory.shape == (batch, m, n, 2)
    fit &= state.rounds.shape[0] == batch and state.executed.shape == (batch, rounds, n)
    if not fit:
        raise ValueError("the arrays of this state do not belong together")
    for b in range(batch):
        row = state.rows[b]
        if row.n_tasks > n or row.n_agents > m or row.n_rounds > rounds or row.acting >= row.n_agents:
            raise ValueError("a row of this state does not fit into its arrays")
        if row.acting != NOBODY and (row.round >= row.n_rounds or row.dispatched >= row.n_tasks):
            raise ValueError("a row of this state runs on after its last round")


@kernel
def step(state: State, rules: Rules, actions: np.ndarray) -> None:
    """Take a turn, int64 (B,), in every row that is not over, and go on to its next acting agent."""
    require_consistent(state, len(actions))
    for b in range(len(actions)):
        row = state.rows[b]
        row.reward = 0.0
        row.conflict = False
        row.elapsed = 0
        if row.acting == NOBODY:
            continue
        before = row.time
        decide(state, rules, b, actions[b])
        row.paid += row.reward
        row.acting = NOBODY if row.dispatched == row.n_tasks else pick_agent(state, rules, b)
        if row.acting == NOBODY:
            end_round(state, rules, b)
        row.elapsed = row.time - before


@kernel
def begin_rows(state: State, rules: Rules, rows: np.ndarray) -> None:
    """`begin_episode` for each of `rows`, int64 (n,)."""
    for b in rows:
        begin_episode(state, rules, b)


@kernel
def play_round(state: State, rules: Rules, b: int, tasks: np.ndarray, agents: np.ndarray) -> None:
    """Take int64 (K,) tasks and agents as this round's whole plan in row b, then end the round.

    Raises ValueError for a row whose episode is over, and for more tasks than it has.
    """
    require_consistent(state, len(state.rows))
    row = state.rows[b]
    if row.acting == NOBODY or len(tasks) > row.n_tasks or len(agents) != len(tasks):
        raise ValueError("no round of this row can take this plan")
    before = row.time
    row.reward = 0.0
    row.conflict = False
    state.tasks[b].agent[:] = NOBODY
    for k in range(len(tasks)):
        state.order[b, k] = tasks[k]
        state.tasks[b, tasks[k]].agent = agents[k]
        state.tasks[b, tasks[k]].committed = 0
    row.dispatched = len(tasks)
    end_round(state, rules, b)
    row.elapsed = row.time - before

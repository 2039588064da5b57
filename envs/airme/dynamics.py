"""The AirME simulator as compiled kernels over plain arrays (dissertation, section 6.2).

The arrays are those of `marl_sched.envs.airme.state`. The order of events within an hour and the facts that the
dissertation leaves open are written beside the lines that implement them.
"""

from __future__ import annotations

import numpy as np

from marl_sched.envs.airme.state import (
    AVAILABILITY,
    BEGUN,
    BROKEN,
    FLYING,
    GROUNDED,
    IDLE,
    MISSED,
    PROFIT,
    REPAIR,
    REPAIRED,
    REVENUE,
    SINGLE,
    SKIP,
    UNDECIDED,
    Record,
    Rules,
    State,
)
from marl_sched.envs.airme.streams import Stream
from marl_sched.kernels import kernel
from marl_sched.noise import integer, time_key, uniform

REPAIR_HOURS = (2, 8)
HOURS_PER_REPAIR_HOUR = 24
LANDINGS_PER_REPAIR_HOUR = 6
BROKEN_REPAIR_HOURS = 12
COST_SHARE_OF_INCOME = (0.1, 1.0)
LABOUR_COST = 2.0  # per hour
BROKEN_COST = 48.0
MISSION_HOURS = (5, 10)


_REPAIR_HOURS, _REPAIR_COST = int(Stream.REPAIR_HOURS), int(Stream.REPAIR_COST)
_MISSION, _MISSION_HOURS, _FAILURE = int(Stream.MISSION), int(Stream.MISSION_HOURS), int(Stream.FAILURE)


@kernel(inline="always")
def start_repair(plane: Record, slot: int, crew: int, time_word: np.uint64) -> None:
    """Send a crew to a plane: draw the job's hours, then its cost; a running mission ends without a landing."""
    hours = integer(uniform(time_word, _REPAIR_HOURS, slot, 0), REPAIR_HOURS[0], REPAIR_HOURS[1])
    hours += plane.hours // HOURS_PER_REPAIR_HOUR + plane.landings // LANDINGS_PER_REPAIR_HOUR
    low, high = COST_SHARE_OF_INCOME
    cost = (low + (high - low) * uniform(time_word, _REPAIR_COST, slot, 0)) * plane.income
    if plane.broken:
        hours += BROKEN_REPAIR_HOURS
        cost += BROKEN_COST
    cost += LABOUR_COST * hours
    plane.crew = crew
    plane.job_hours = hours
    plane.job_done = 0
    plane.job_cost = cost / hours
    plane.mission_hours = 0
    plane.mission_done = 0


@kernel(inline="always")
def fails(plane: Record, slot: int, failure: np.ndarray, time_word: np.uint64) -> bool:
    """Whether a part of a flying plane fails this hour, on the counters as they stood before the hour (eq. 6.1)."""
    for part in range(failure.shape[1]):
        usage = plane.landings if part == 0 else plane.hours
        probability = failure[plane.kind, part, usage]
        if probability > 0.0 and uniform(time_word, _FAILURE, slot, part) < probability:
            return True
    return False


@kernel(inline="always")
def fly(plane: Record, slot: int, usage: np.ndarray, failure: np.ndarray, time_word: np.uint64) -> None:
    """A plane's hour outside repair: it may start a mission, and while it flies it may fail."""
    if plane.broken:
        return
    if plane.mission_hours == 0 and uniform(time_word, _MISSION, slot, 0) < usage[plane.kind]:
        plane.mission_hours = integer(uniform(time_word, _MISSION_HOURS, slot, 0), MISSION_HOURS[0], MISSION_HOURS[1])
        plane.mission_done = 0
    if plane.mission_hours == 0:
        return
    if fails(plane, slot, failure, time_word):
        plane.broken = True  # counters stand still until the repair, and the mission ends without a landing
        plane.mission_hours = 0
        plane.mission_done = 0
    else:
        plane.hours += 1
        plane.mission_done += 1


@kernel(inline="always")
def release(plane: Record, crews: np.ndarray) -> None:
    """End of the hour: a finished repair makes the plane new and the crew free, a finished mission lands."""
    if plane.crew >= 0:
        if plane.job_done >= plane.job_hours:
            crews[plane.crew].plane = 0
            crews[plane.crew].job_hours = 0
            crews[plane.crew].job_done = 0
            plane.crew = -1
            plane.job_hours = 0
            plane.job_done = 0
            plane.job_cost = 0.0
            plane.hours = 0
            plane.landings = 0
            plane.broken = False
    elif plane.mission_hours > 0 and plane.mission_done >= plane.mission_hours:
        plane.landings += 1
        plane.mission_hours = 0
        plane.mission_done = 0


@kernel(inline="always")
def count_missed(work: np.ndarray, planes: np.ndarray, crews: np.ndarray, row: Record) -> None:
    """Count an hour for every crew that stays free while a broken plane stands unattended."""
    free = 0
    for crew in range(row.n_crews):
        free += crews[crew].plane == 0
    if free == 0:
        return
    for slot in range(1, row.n_planes + 1):
        if planes[slot].broken and planes[slot].crew < 0:
            for crew in range(row.n_crews):
                work[crew, MISSED] += crews[crew].plane == 0
            return


@kernel
def hour(state: State, rules: Rules, b: int) -> tuple[float, float, int, int]:
    """One hour of row b; returns (income, repair cost, planes available, planes broken).

    Decisions apply first and their hour is the first hour of repair. What each plane did is noted where the state
    records a timeline.
    """
    row, planes, crews = state.rows[b], state.planes[b], state.crews[b]
    time_word = time_key(row.episode, row.time)
    for crew in range(row.n_crews):
        action = crews[crew].choice
        crews[crew].choice = UNDECIDED
        if action > 0:
            start_repair(planes[action], action, crew, time_word)
            crews[crew].plane = action
            crews[crew].job_hours = planes[action].job_hours
            crews[crew].job_done = 0
            state.work[b, crew, BEGUN] += 1
    count_missed(state.work[b], planes, crews, row)
    income = 0.0
    cost = 0.0
    available = 0
    broken = 0
    for slot in range(1, row.n_planes + 1):
        plane = planes[slot]
        plane.chosen = -1
        if plane.crew >= 0:
            plane.job_done += 1
            crews[plane.crew].job_done = plane.job_done
            cost += plane.job_cost
            state.work[b, plane.crew, REPAIRED] += 1
            if state.timeline.shape[0] > 0:
                state.jobs[b, row.time, plane.crew] = slot
        else:
            fly(plane, slot, rules.usage, rules.failure, time_word)
            if plane.mission_hours > 0:
                income += plane.income
            if not plane.broken:
                available += 1
        if state.timeline.shape[0] > 0:
            state.timeline[b, row.time, slot] = _status(plane)
        release(plane, crews)
        if plane.broken:
            broken += 1
    return income, cost, available, broken


@kernel(inline="always")
def _status(plane: Record) -> int:
    if plane.crew >= 0:
        return REPAIR
    if plane.broken:
        return BROKEN
    return FLYING if plane.mission_hours > 0 else GROUNDED


@kernel(inline="always")
def next_free(crews: np.ndarray, n_crews: int) -> int:
    """The lowest crew that is free and undecided, -1 if there is none."""
    for crew in range(n_crews):
        if crews[crew].plane == 0 and crews[crew].choice == UNDECIDED:
            return crew
    return -1


@kernel
def decide(state: State, b: int, crew: int, action: int) -> None:
    """Note a crew's choice in row b; one that is impossible in truth idles the crew for this hour."""
    row, planes = state.rows[b], state.planes[b]
    if action == IDLE:
        state.crews[b, crew].choice = IDLE
    elif action <= row.n_planes and planes[action].crew < 0 and planes[action].chosen < 0:
        state.crews[b, crew].choice = action
        planes[action].chosen = crew
    else:
        row.conflict = True
        state.crews[b, crew].choice = IDLE
        if action <= row.n_planes and state.private_memory_at.shape[0] > 0:
            state.private_memory[b, crew, action] = planes[action]
            state.private_memory_at[b, crew, action] = row.time


@kernel
def pass_hour(state: State, rules: Rules, b: int) -> None:
    """Let one hour pass in row b, keep the books, and see whether the episode ends."""
    row, t = state.rows[b], state.rows[b].time
    income, cost, available, broken = hour(state, rules, b)
    series = state.series[b, t]
    series[PROFIT] = (income - cost) / row.total_income
    series[REVENUE] = income / row.total_income
    series[AVAILABILITY] = available / row.n_planes
    for k in range(3):
        row.sums[k] += series[k]
    row.reward += series[rules.objective]
    row.elapsed += 1
    row.time = t + 1
    if state.past.shape[1] > 0:
        state.past[b, (t + 1) % state.past.shape[1]] = state.planes[b]
    if rules.stop_share > 0.0 and broken >= rules.stop_share * row.n_planes:
        row.terminated = True
    elif t + 1 >= rules.horizon:
        row.truncated = True


@kernel
def pass_hour_with_memory(state: State, rules: Rules, b: int) -> None:
    """As `pass_hour`, for views in which crews remember: who finished a repair knows the plane as it left it."""
    row, crews = state.rows[b], state.crews[b]
    jobs = np.empty(row.n_crews, np.int32)
    for crew in range(row.n_crews):
        jobs[crew] = max(crews[crew].plane, crews[crew].choice)
    pass_hour(state, rules, b)
    for crew in range(row.n_crews):
        slot = jobs[crew]
        if slot > 0 and crews[crew].plane == 0:
            state.private_memory[b, crew, slot] = state.planes[b, slot]
            state.private_memory_at[b, crew, slot] = row.time


@kernel
def begin_step(row: Record) -> None:
    """Forget what the last step brought."""
    row.reward = 0.0
    row.elapsed = 0
    row.conflict = False


@kernel
def require_consistent(state: State, rules: Rules, batch: int) -> None:
    """Raise ValueError where arrays do not belong together or a row does not fit into them: writing would go astray.

    Compiled code does not check its indices, so every entry point that writes begins with this.
    """
    slots, crews, hours = state.planes.shape[1], state.crews.shape[1], state.series.shape[1]
    fit = state.rows.shape[0] == state.planes.shape[0] == state.crews.shape[0] == state.series.shape[0] == batch
    fit &= rules.horizon <= hours and (state.timeline.shape[0] == 0 or state.timeline.shape == (batch, hours, slots))
    fit &= state.work.shape[0] == batch and state.work.shape[1] == crews
    fit &= state.timeline.shape[0] == 0 or state.jobs.shape == (batch, hours, crews)
    fit &= state.past.shape[0] == batch and state.past.shape[2] == slots
    fit &= state.private_memory_at.shape == state.private_memory.shape and state.private_memory_at.shape[0] in (
        0,
        batch,
    )
    if not fit:
        raise ValueError("the arrays of this state do not belong together")
    for b in range(batch):
        row = state.rows[b]
        if row.n_planes >= slots or row.n_crews > crews or row.acting >= row.n_crews or row.time < 0:
            raise ValueError("a row of this state does not fit into its arrays")
        if row.time >= rules.horizon and not (row.terminated or row.truncated):
            raise ValueError("a row of this state runs on after its horizon")


@kernel
def pass_hours(state: State, rules: Rules, b: int) -> None:
    """Let hours pass in row b, one at least, until a crew of it is free to act or the episode ends."""
    row, following = state.rows[b], -1
    while following < 0 and not row.terminated and not row.truncated:
        if state.private_memory_at.shape[0] > 0:
            pass_hour_with_memory(state, rules, b)
        else:
            pass_hour(state, rules, b)
        following = next_free(state.crews[b], row.n_crews)
    row.acting = -1 if row.terminated or row.truncated else following


@kernel(inline="always")
def ends_epoch(scheme: int, action: int) -> bool:
    """Whether nobody else is asked at a decision epoch after this action (section 6.3.1)."""
    return scheme == SINGLE or (scheme == SKIP and action == IDLE)


@kernel
def take_turn(state: State, rules: Rules, b: int, action: int) -> None:
    """The acting crew of row b, which is not over, chooses; after the last one of the hour hours pass."""
    row = state.rows[b]
    begin_step(row)
    decide(state, b, row.acting, action)
    following = -1 if ends_epoch(rules.scheme, action) else next_free(state.crews[b], row.n_crews)
    if following < 0:
        pass_hours(state, rules, b)
    else:
        row.acting = following


@kernel
def step(state: State, rules: Rules, actions: np.ndarray) -> int:
    """Take a turn, int64 (B,), in every row that is not over.

    Returns the index of the first action that is not a slot, and then nothing was played, or -1.
    """
    require_consistent(state, rules, actions.shape[0])
    bad = first_outside(actions, state.planes.shape[1])
    if bad >= 0:
        return bad
    # As `take_turn`, written out: handing on the state for every row takes a tenth of the time of a step.
    for b in range(actions.shape[0]):
        row = state.rows[b]
        begin_step(row)
        if row.acting < 0:
            continue
        decide(state, b, row.acting, actions[b])
        following = -1 if ends_epoch(rules.scheme, actions[b]) else next_free(state.crews[b], row.n_crews)
        if following < 0:
            pass_hours(state, rules, b)
        else:
            row.acting = following
    return -1


@kernel
def first_outside(actions: np.ndarray, n_actions: int) -> int:
    """Flat index of the first of actions, int64 of any shape, that is not in [0, n_actions), -1 if there is none."""
    flat = actions.ravel()
    for i in range(flat.shape[0]):
        if flat[i] < 0 or flat[i] >= n_actions:
            return i
    return -1


@kernel
def play_hour(state: State, rules: Rules, choices: np.ndarray) -> int:
    """Play one hour in every row that is not over, with an action for each crew, int64 (B, C).

    This is the centralised interface of section 6.2.4: actions of busy crews are ignored, impossible ones idle
    the crew. Afterwards `acting` is the first free crew, -1 if all are busy. Returns as `step`.
    """
    require_consistent(state, rules, choices.shape[0])
    bad = first_outside(choices, state.planes.shape[1])
    if bad >= 0:
        return bad
    for b in range(choices.shape[0]):
        row = state.rows[b]
        begin_step(row)
        if row.terminated or row.truncated:
            continue
        for crew in range(row.n_crews):
            if state.crews[b, crew].plane == 0:
                decide(state, b, crew, choices[b, crew])
        if state.private_memory_at.shape[0] > 0:
            pass_hour_with_memory(state, rules, b)
        else:
            pass_hour(state, rules, b)
        over = row.terminated or row.truncated
        row.acting = -1 if over else next_free(state.crews[b], row.n_crews)
    return -1

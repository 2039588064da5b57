"""One plane as a finite-horizon Markov decision process: its best expected return when crews cost a price.

At the start of every hour a plane that is not in repair may be sent to repair, flying or not, exactly as in
the simulator (marl_sched.envs.airme.dynamics). A repair has no decisions and ends in a new plane, so that it
needs no state of its own: its value is that of a new plane D hours on, less cost and price. What is left is

    value[0..9]  healthy, with that many mission hours to go at the start of the hour, 0: grounded
    value[10]    broken

each over (landings, hours). Counters are followed up to a cap; beyond it a plane counts as one that never
fails again. That errs upwards: a plane that never fails and is never repaired flies at least as much as any
(over n hours from the ground it flies U(n) on average, U(n + 1) - U(n) is the probability of flying in one
hour and therefore at most 1, so r hours of a mission and then U(n - r) are at least U(n); a repair leads to
U(n - D) at most; costs and prices are not negative).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_sched.envs.airme.aircraft import AircraftType, FailureModel, failure_table
from marl_sched.envs.airme.dynamics import (
    BROKEN_COST,
    BROKEN_REPAIR_HOURS,
    COST_SHARE_OF_INCOME,
    HOURS_PER_REPAIR_HOUR,
    LABOUR_COST,
    LANDINGS_PER_REPAIR_HOUR,
    MISSION_HOURS,
    REPAIR_HOURS,
)
from marl_sched.kernels import kernel

BROKEN = MISSION_HOURS[1]  # index of broken planes; below it hours of mission to go
HOURS_CAP, LANDINGS_CAP = 300, 50


class PlaneModel(NamedTuple):
    """What a type's decision process is made of; L and H are the caps of landings and hours."""

    usage: float  # probability that a grounded, healthy plane starts a mission
    failure: np.ndarray  # float64 (L + 1, H + 1), probability that a flying plane fails
    first: np.ndarray  # int64 (L + 1,), least hours that can be reached with so many landings
    last: np.ndarray  # int64 (L + 1,), most hours, at most H


class Reward(NamedTuple):
    """What an hour brings and a repair costs, in the unit of the prices."""

    flying: float  # an hour in the air
    standing: float  # an hour on the ground, healthy
    once: float  # a repair's expected one-time cost
    broken: float  # what a failure adds to it
    labour: float  # an hour of repair


def reward_of(objective: str, income: float) -> Reward:
    """The reward of a plane with this hourly income; unit: money, or for availability plane-hours."""
    if objective == "availability":
        return Reward(1.0, 1.0, 0.0, 0.0, 0.0)
    if objective == "revenue":
        return Reward(income, 0.0, 0.0, 0.0, 0.0)
    return Reward(income, 0.0, sum(COST_SHARE_OF_INCOME) / 2 * income, BROKEN_COST, LABOUR_COST)


def plane_model(kind: AircraftType, model: FailureModel, hours: np.ndarray, landings: np.ndarray) -> PlaneModel:
    """The decision process of a type whose planes start new or with these counters, int (N,) each.

    Only counters that can be reached from there are kept: a landing takes 5 to 10 hours.
    """
    parts = failure_table([kind], max(HOURS_CAP, LANDINGS_CAP), model)[0]
    survival = np.ones((LANDINGS_CAP + 1, HOURS_CAP + 1)) * (1.0 - parts[0, : LANDINGS_CAP + 1, None])
    for part in parts[1:]:
        survival *= 1.0 - part[None, : HOURS_CAP + 1]
    count = np.arange(LANDINGS_CAP + 1)[:, None]
    more = count - np.concatenate([[0], landings])
    start = np.concatenate([[0], hours])
    low, high = MISSION_HOURS
    first = np.where(more >= 0, start + low * more, HOURS_CAP + 1).min(axis=1)
    last = np.where(more >= 0, start + high * more + high - 1, -1).max(axis=1)
    return PlaneModel(float(kind.usage), 1.0 - survival, first, np.minimum(last, HOURS_CAP))


@kernel
def mission_mean(value: np.ndarray, landings: int, hours: int) -> float:
    """The mean over mission lengths of the value after a mission's first hour."""
    total = 0.0
    for length in range(MISSION_HOURS[0], MISSION_HOURS[1] + 1):
        total += value[length - 1, landings, hours]
    return total / (MISSION_HOURS[1] - MISSION_HOURS[0] + 1)


@kernel
def wear(landings: int, hours: int) -> int:
    """Repair hours that a plane's counters add."""
    return hours // HOURS_PER_REPAIR_HOUR + landings // LANDINGS_PER_REPAIR_HOUR


@kernel
def repair_values(time: int, horizon: int, reward: Reward, paid: np.ndarray, new: np.ndarray, out: np.ndarray) -> None:
    """Expected value of sending a crew now, float64 (2, wear) for healthy and broken planes.

    `paid` float64 (T + 1,) sums the prices of the hours before, `new` float64 (T + 1,) is a new plane's value.
    What lies beyond the horizon is neither charged nor paid for.
    """
    draws = REPAIR_HOURS[1] - REPAIR_HOURS[0] + 1
    for broken in range(2):
        for extra in range(out.shape[1]):
            total = 0.0
            for draw in range(REPAIR_HOURS[0], REPAIR_HOURS[1] + 1):
                length = draw + extra + broken * BROKEN_REPAIR_HOURS
                end = min(time + length, horizon)
                hourly = (reward.once + broken * reward.broken) / length + reward.labour
                total += new[end] - hourly * (end - time) - (paid[end] - paid[time])
            out[broken, extra] = total / draws


@kernel
def immortal_values(model: PlaneModel, reward: Reward, horizon: int) -> np.ndarray:
    """Values float64 (T + 1, 10) of a plane that never fails, by mission hours to go: what the caps stand for."""
    high = MISSION_HOURS[1]
    out = np.zeros((horizon + 1, high))
    for time in range(horizon - 1, -1, -1):
        mean = 0.0
        for length in range(MISSION_HOURS[0], high + 1):
            mean += out[time + 1, length - 1] / (high - MISSION_HOURS[0] + 1)
        start = model.usage * (reward.flying + mean)
        out[time, 0] = start + (1.0 - model.usage) * (reward.standing + out[time + 1, 0])
        for left in range(1, high):
            out[time, left] = reward.flying + out[time + 1, left - 1]
    return out


@kernel
def one_hour(model: PlaneModel, reward: Reward, repair: np.ndarray, later: np.ndarray, now: np.ndarray) -> None:
    """One step of backward induction: `now` from `later`, float64 (11, L + 2, H + 2) each.

    The last rows and columns of `later` hold what the caps stand for. Loops run along the hours, which lie
    side by side in memory.
    """
    usage = model.usage
    served = np.empty(model.failure.shape[1])
    for landings in range(model.failure.shape[0]):
        first, last = model.first[landings], model.last[landings] + 1
        fails, broken = model.failure[landings], later[BROKEN, landings]
        for hours in range(first, last):
            extra = wear(landings, hours)
            served[hours] = repair[0, extra]
            now[BROKEN, landings, hours] = max(repair[1, extra], broken[hours])
            started = fails[hours] * broken[hours]
            started += (1.0 - fails[hours]) * (reward.flying + mission_mean(later, landings, hours + 1))
            stayed = reward.standing + later[0, landings, hours]
            now[0, landings, hours] = max(served[hours], usage * started + (1.0 - usage) * stayed)
        for left in range(1, BROKEN):
            following = later[left - 1, landings + (left == 1)]
            out = now[left, landings]
            for hours in range(first, last):
                wait = reward.flying + following[hours + 1]
                wait += fails[hours] * (broken[hours] - wait)
                out[hours] = wait if wait > served[hours] else served[hours]


@kernel
def fill_caps(value: np.ndarray, immortal: np.ndarray) -> None:
    """Write what a plane beyond the caps is worth, float64 (10,), into the last row and column."""
    for state in range(BROKEN + 1):
        worth = immortal[state % BROKEN]  # a broken one at most as much as one on the ground
        value[state, :, value.shape[2] - 1] = worth
        value[state, value.shape[1] - 1, :] = worth


@kernel
def solve(model: PlaneModel, reward: Reward, prices: np.ndarray, policy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Backward induction over the horizon, prices float64 (T,) per crew-hour.

    Returns (values at hour 0 float64 (11, L + 2, H + 2), a new plane's value float64 (T + 1,)). Where `policy`
    has hours, uint8 (T, 11, L + 1, H + 1), it is set to 1 where repairing at once is the best.
    """
    horizon = prices.shape[0]
    n_landings, n_hours = model.failure.shape
    paid = np.zeros(horizon + 1)
    paid[1:] = np.cumsum(prices)
    new = np.zeros(horizon + 1)
    later = np.zeros((BROKEN + 1, n_landings + 1, n_hours + 1))
    now = np.zeros_like(later)
    repair = np.empty((2, wear(n_landings, n_hours) + 1))
    immortal = immortal_values(model, reward, horizon)
    for time in range(horizon - 1, -1, -1):
        repair_values(time, horizon, reward, paid, new, repair)
        one_hour(model, reward, repair, later, now)
        new[time] = now[0, 0, 0]
        if policy.shape[0] > 0:
            note_policy(model, repair, now, policy[time])
        fill_caps(now, immortal[time])
        later, now = now, later
    return later, new


@kernel
def note_policy(model: PlaneModel, repair: np.ndarray, now: np.ndarray, policy: np.ndarray) -> None:
    """Where an hour's value, float64 (11, L + 2, H + 2), is that of a repair."""
    for state in range(BROKEN + 1):
        for landings in range(model.failure.shape[0]):
            for hours in range(model.first[landings], model.last[landings] + 1):
                best = repair[1 if state == BROKEN else 0, wear(landings, hours)]
                policy[state, landings, hours] = now[state, landings, hours] == best


@kernel
def expected_crew_hours(model: PlaneModel, policy: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Crew-hours, float64 (T,), that planes use under a policy, uint8 (T, 11, L + 1, H + 1).

    `mass` float64 (11, L + 2, H + 2) holds how many planes start in which state; it is used up. Planes that pass
    a cap ask for no crew again.
    """
    horizon = policy.shape[0]
    n_landings, n_hours = model.failure.shape
    change = np.zeros(horizon + 1)
    new = np.zeros(horizon + 1)
    jobs = np.empty((2, wear(n_landings, n_hours) + 1))
    following = np.zeros_like(mass)
    for time in range(horizon):
        mass[0, 0, 0] += new[time]
        jobs[:] = 0.0
        following[:] = 0.0
        for landings in range(n_landings):
            for hours in range(model.first[landings], model.last[landings] + 1):
                for state in range(BROKEN + 1):
                    planes = mass[state, landings, hours]
                    if planes == 0.0:
                        continue
                    if policy[time, state, landings, hours]:
                        jobs[1 if state == BROKEN else 0, wear(landings, hours)] += planes
                    else:
                        spend_hour(model, state, landings, hours, planes, following)
        send_crews(time, jobs, change, new)
        mass, following = following, mass
    return np.cumsum(change)[:horizon]


@kernel
def spend_hour(model: PlaneModel, state: int, landings: int, hours: int, planes: float, following: np.ndarray) -> None:
    """Spread planes that are not repaired over where they are an hour later."""
    if state == BROKEN:
        following[BROKEN, landings, hours] += planes
        return
    flying = planes
    if state == 0:
        flying = planes * model.usage
        following[0, landings, hours] += planes - flying
    failed = flying * model.failure[landings, hours]
    following[BROKEN, landings, hours] += failed
    flying -= failed
    if state == 1:
        following[0, landings + 1, hours + 1] += flying
    elif state > 1:
        following[state - 1, landings, hours + 1] += flying
    else:
        lengths = MISSION_HOURS[1] - MISSION_HOURS[0] + 1
        for length in range(MISSION_HOURS[0], MISSION_HOURS[1] + 1):
            following[length - 1, landings, hours + 1] += flying / lengths


@kernel
def send_crews(time: int, jobs: np.ndarray, change: np.ndarray, new: np.ndarray) -> None:
    """Book the repairs of an hour, float64 (2, wear): crews in use as differences, planes that come back new."""
    horizon = new.shape[0] - 1
    draws = REPAIR_HOURS[1] - REPAIR_HOURS[0] + 1
    for broken in range(2):
        for extra in range(jobs.shape[1]):
            planes = jobs[broken, extra] / draws
            if planes == 0.0:
                continue
            change[time] += planes * draws
            for draw in range(REPAIR_HOURS[0], REPAIR_HOURS[1] + 1):
                end = min(time + draw + extra + broken * BROKEN_REPAIR_HOURS, horizon)
                change[end] -= planes
                new[end] += planes


@kernel
def index_slices(model: PlaneModel, reward: Reward, prices: np.ndarray, hours: np.ndarray, out: np.ndarray) -> None:
    """Advantage of repairing now over waiting an hour, per expected repair hour, at some hours int64 (S,).

    Written to `out` float32 (S, 11, L + 1, H + 1), the hours ascending.
    """
    horizon = prices.shape[0]
    n_landings, n_hours = model.failure.shape
    paid = np.zeros(horizon + 1)
    paid[1:] = np.cumsum(prices)
    new = np.zeros(horizon + 1)
    later = np.zeros((BROKEN + 1, n_landings + 1, n_hours + 1))
    now, wait = np.zeros_like(later), np.zeros_like(later)
    repair = np.empty((2, wear(n_landings, n_hours) + 1))
    never = np.full_like(repair, -np.inf)
    immortal = immortal_values(model, reward, horizon)
    which = hours.shape[0] - 1
    for time in range(horizon - 1, -1, -1):
        repair_values(time, horizon, reward, paid, new, repair)
        if which >= 0 and hours[which] == time:
            one_hour(model, reward, never, later, wait)
            note_advantage(model, repair, wait, out[which])
            which -= 1
        one_hour(model, reward, repair, later, now)
        new[time] = now[0, 0, 0]
        fill_caps(now, immortal[time])
        later, now = now, later


@kernel
def note_advantage(model: PlaneModel, repair: np.ndarray, wait: np.ndarray, out: np.ndarray) -> None:
    """What a repair is worth beyond waiting, float64 (11, L + 2, H + 2), per expected hour of it."""
    mean_draw = (REPAIR_HOURS[0] + REPAIR_HOURS[1]) / 2
    for state in range(BROKEN + 1):
        broken = 1 if state == BROKEN else 0
        for landings in range(model.failure.shape[0]):
            for hours in range(model.first[landings], model.last[landings] + 1):
                extra = wear(landings, hours)
                length = mean_draw + extra + broken * BROKEN_REPAIR_HOURS
                out[state, landings, hours] = (repair[broken, extra] - wait[state, landings, hours]) / length

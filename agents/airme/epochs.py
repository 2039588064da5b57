"""Decision epochs of AirME played in one call: all rows, all free crews of an hour, without observations.

The choices, and every bit of the state after them, are those of turns (a test holds the two against each other).
Where the view hides nothing, all crews of an hour see the same, so that one queue of its planes serves them: an
hour then costs a time linear in planes and crews. Elsewhere each crew ranks the planes that its view lets it see.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from marl_sched.agents.airme.ranking import CORRECTIVE, Known, Ranking, rank, ranking
from marl_sched.compiled import entry
from marl_sched.envs.airme.dynamics import begin_step, decide, ends_epoch, pass_hours, require_consistent, take_turn
from marl_sched.envs.airme.features import INCOME_SCALE, PER_INCOME
from marl_sched.envs.airme.simulator import AirmeSimulator, example
from marl_sched.envs.airme.state import IDLE, UNDECIDED, Record, Rules, State
from marl_sched.envs.airme.views import ring_distance
from marl_sched.kernels import kernel


class EpochPlayer:
    """Plays decision epochs of a simulator by a ranking; see Scheduler.epoch_player."""

    def __init__(self, simulator: AirmeSimulator, of: Ranking) -> None:
        self._simulator, self._ranking, self._play = simulator, of, _play()

    def __call__(self, count: int) -> tuple[float, int]:
        """Play up to `count` decision epochs in every row that is not over.

        Returns the sum over all decisions of the share of planes that the deciding crew saw, and their number.
        """
        of = self._simulator
        return self._play(of.state, of.rules, of.limits, self._ranking, count)


@cache
def _play() -> Any:
    return entry(play_epochs, *example(), np.zeros((1, 3), np.int64), ranking(CORRECTIVE), 1)


@kernel
def play_epochs(state: State, rules: Rules, limits: np.ndarray, of: Ranking, count: int) -> tuple[float, int]:
    """Play up to `count` decision epochs in every row; `limits` int64 (B, 3), see marl_sched.envs.airme.views."""
    require_consistent(state, rules, limits.shape[0])
    shares, turns = 0.0, 0
    keys = np.empty(state.planes.shape[1])
    slots = np.empty(state.planes.shape[1], np.int64)
    heard = np.full(state.planes.shape[1], -1)
    for b in range(state.rows.shape[0]):
        row = state.rows[b]
        half = row.n_crews // 2  # no two crews are farther apart on the ring
        seen = limits[b, 0] >= half and limits[b, 1] >= half and limits[b, 2] == 0
        begin_step(row)
        for _ in range(count):
            if row.acting < 0:
                break
            if seen:
                taken = play_queue(state, rules, b, of, keys, slots)
                shares += taken
                turns += taken
            else:
                hour = row.time
                while row.acting >= 0 and row.time == hour:
                    action, share = choose(state, rules, b, limits[b], of, heard, turns)
                    shares += np.float64(np.float32(share))
                    turns += 1
                    take_turn(state, rules, b, action)
    return shares, turns


@kernel
def play_queue(state: State, rules: Rules, b: int, of: Ranking, keys: np.ndarray, slots: np.ndarray) -> int:
    """The free crews of row b take planes off one queue, then hours pass; returns how many crews decided.

    `keys` float64 and `slots` int64 (P + 1,) are space for the queue.
    """
    row, crews = state.rows[b], state.crews[b]
    begin_step(row)
    queued = open_planes(state, rules, b, of, keys, slots)
    turns, crew, following = 0, row.acting, 0
    while True:
        action = IDLE
        if queued > 0:
            action = slots[0]
            queued -= 1
            keys[0], slots[0] = keys[queued], slots[queued]
            sink(keys, slots, 0, queued)
        decide(state, b, crew, action)
        turns += 1
        if ends_epoch(rules.scheme, action):
            break
        while following < row.n_crews and (crews[following].plane != 0 or crews[following].choice != UNDECIDED):
            following += 1
        if following == row.n_crews:
            break
        crew = following
    pass_hours(state, rules, b)
    return turns


@kernel
def open_planes(state: State, rules: Rules, b: int, of: Ranking, keys: np.ndarray, slots: np.ndarray) -> int:
    """Write the planes of row b that nobody has in hand and the rule serves as a heap; returns their number."""
    row, planes = state.rows[b], state.planes[b]
    queued = 0
    if row.time % of.period == 0:
        for slot in range(1, row.n_planes + 1):
            plane = planes[slot]
            if plane.crew < 0 and plane.chosen < 0:
                key = rank(known(plane), row.time, rules.failure, of)
                if key > of.least:
                    keys[queued], slots[queued] = key, slot
                    queued += 1
    for k in range(queued // 2 - 1, -1, -1):
        sink(keys, slots, k, queued)
    return queued


@kernel
def sink(keys: np.ndarray, slots: np.ndarray, k: int, size: int) -> None:
    """Restore a heap of `size` entries below entry k: the highest key first, ties to the lowest slot."""
    key, slot = keys[k], slots[k]
    while True:
        child = 2 * k + 1
        if child >= size:
            break
        if child + 1 < size and before(keys[child + 1], slots[child + 1], keys[child], slots[child]):
            child += 1
        if not before(keys[child], slots[child], key, slot):
            break
        keys[k], slots[k] = keys[child], slots[child]
        k = child
    keys[k], slots[k] = key, slot


@kernel(inline="always")
def before(key: float, slot: int, other_key: float, other_slot: int) -> bool:
    """Whether a plane is served before another."""
    return key > other_key or (key == other_key and slot < other_slot)


@kernel(inline="always")
def known(plane: Record) -> Known:
    """What a crew that sees this status of a plane knows of it."""
    return Known(
        plane.kind,
        plane.broken,
        plane.hours,
        plane.landings,
        np.float64(np.float32(plane.income * PER_INCOME)) * INCOME_SCALE,
        plane.mission_hours - plane.mission_done,
    )


@kernel
def choose(
    state: State, rules: Rules, b: int, limits: np.ndarray, of: Ranking, heard: np.ndarray, turn: int
) -> tuple[int, float]:
    """The acting crew's choice in row b under its view, and the share of planes that it sees.

    `heard` int64 (P + 1,) notes with the number of the turn which planes visible crews say they have in hand.
    """
    row, crews = state.rows[b], state.crews[b]
    agent, n_crews = row.acting, row.n_crews
    for crew in range(n_crews):
        if ring_distance(agent, crew, n_crews) <= limits[1]:
            heard[max(crews[crew].plane, crews[crew].choice, 0)] = turn
    best, best_slot, visible = of.least, IDLE, 0
    for sector in range(n_crews):
        if ring_distance(agent, sector, n_crews) > limits[0]:
            continue
        for slot in range(sector + 1, row.n_planes + 1, n_crews):
            visible += 1
            if heard[slot] == turn or row.time % of.period != 0:
                continue
            plane, age = state.planes[b, slot], 0
            if sector != agent and limits[2] > 0:
                snapshot_hour, learnt = max(0, row.time - limits[2]), state.private_memory_at[b, agent, slot]
                if learnt >= snapshot_hour:
                    plane, age = state.private_memory[b, agent, slot], row.time - learnt
                else:
                    plane = state.past[b, snapshot_hour % state.past.shape[1], slot]
                    age = row.time - snapshot_hour
            if plane.crew >= 0 or (age > 0 and plane.chosen >= 0):
                continue  # somebody has it in hand, as far as the crew knows
            key = rank(known(plane), row.time, rules.failure, of)
            if key > best or (key == best and slot < best_slot):
                best, best_slot = key, slot
    return best_slot, visible / row.n_planes

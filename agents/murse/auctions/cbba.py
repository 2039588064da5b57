"""CBBA: the consensus-based bundle algorithm (Choi, Brunet and How, 2009).

Each agent adds tasks to its bundle for as long as it can outbid the winners it knows of, then tells its neighbours
what it believes of all bids; a task lost to a higher bid leaves the bundle with all that were added after it. A
bid is what the agent's temporal network gives: the earlier its work ends with the task, the higher. It is never
higher than the bids before it in the bundle, which the algorithm needs to come to an end (Johnson et al., 2011).

Where this differs from the paper: tasks that wait for others are shared out in waves, each wave when all that it
waits for is settled, as the paper knows no waits between agents. Near tasks of one wave do not count in bids;
when a wave is settled everybody puts them in the one of four orders that is the least late. A task that no network
has room for gives up its deadline and is bid on below all others.
"""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.auctions.agent_schedule import UNKNOWN, AgentSchedule
from marl_sched.agents.murse.auctions.consensus import LEAVE, UPDATE, resolve
from marl_sched.agents.murse.auctions.messages import Consensus, decode, encode
from marl_sched.agents.murse.auctions.network import Bidder
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.timetable import time_order
from marl_sched.errors import InvalidMessageError

_NOBODY = -1
_BEST = 1e9  # a bid is this less the end of work, so that an earlier end bids higher
_NO_BID = -1e18
_NEVER = 1 << 40  # the deadline of a task without one
_EXCHANGES_PER_TASK = 8  # of a wave, for each agent; more are never seen, but a wave must end


class CbbaBidder(Bidder):
    """One agent's side of the consensus; `schedule` holds the outcome."""

    def __init__(self, schedule: AgentSchedule, n_agents: int) -> None:
        n = len(schedule.holder)
        self.schedule, self._n_agents = schedule, n_agents
        self._waves = waves(schedule.lags)
        self._deadlines = schedule.deadlines.copy()
        self._turn = self._exchanges = 0
        self._winners, self._bids = np.full(n, _NOBODY), np.full(n, _NO_BID)
        self._starts, self._finishes = np.full(n, UNKNOWN), np.full(n, UNKNOWN)
        self._heard = np.full(n_agents, -1)
        self._bundle: list[int] = []
        self._path: list[int] = []
        self._late: set[int] = set()
        self._messages: list[Consensus] = []
        self._quiet = 0
        self._before: tuple[np.ndarray, np.ndarray] = (self._winners.copy(), self._bids.copy())

    @property
    def finished(self) -> bool:
        """Whether all waves are settled."""
        return not self._waves

    def speak(self) -> bytes:
        """Add to the bundle what can be won, and say what is believed."""
        self._add_to_bundle()
        self._heard[self.schedule.agent] = self._turn
        self._messages = []
        return encode(
            Consensus(
                self.schedule.agent, self._turn, self._winners.tolist(), self._bids.tolist(), self._starts.tolist(),
                self._finishes.tolist(), self._heard.tolist(), self._quiet,
            )
        )  # fmt: skip

    def hear(self, payload: bytes) -> None:
        """Another agent's beliefs."""
        message = decode(payload)
        if not isinstance(message, Consensus):
            raise InvalidMessageError(f"cbba: expected a consensus message, got {type(message).__name__}")
        self._messages.append(message)

    def conclude(self) -> None:
        """Take over fresher and higher bids, drop what was lost, and end the wave if it has settled."""
        for message in self._messages:
            self._take_in(message)
        self._release_lost()
        now = (self._winners.copy(), self._bids.copy())
        still = all(np.array_equal(a, b) for a, b in zip(now, self._before, strict=True))
        heard = [message.quiet for message in self._messages]
        self._quiet = 1 + min([self._quiet, *heard]) if still else 0
        self._before = now
        self._turn += 1
        self._exchanges += 1
        limit = _EXCHANGES_PER_TASK * self._n_agents * (len(self._waves[0]) + 1)
        if self._quiet > self._n_agents or self._exchanges >= limit:
            self._settle()

    def _add_to_bundle(self) -> None:
        wave = [task for task in self._waves[0] if self.schedule.ready(task)]
        while True:
            best: tuple[float, int, int] | None = None
            for task in wave:
                if task in self._bundle:
                    continue
                place, bid = self._bid(task)
                if self._outbids(bid, task) and (best is None or bid > best[0]):
                    best = bid, task, place
            if best is None:
                break
            bid, task, place = best
            self._bundle.append(task)
            if place < 0:
                self._late.add(task)
            self._path = self._with(task, place)
            self._winners[task], self._bids[task] = self.schedule.agent, bid
        self._promise()

    def _bid(self, task: int) -> tuple[int, float]:
        """Where the task goes in the path, -1 for late at its end, and the bid on it."""
        schedule = self._working_schedule()
        place, end, _ = schedule.place(task)
        value = _BEST - end if place >= 0 else -float(schedule.end_of(task))
        return place, min([value, *(float(self._bids[other]) for other in self._bundle)])

    def _outbids(self, bid: float, task: int) -> bool:
        tie = bid == self._bids[task] and self.schedule.agent < self._winners[task]
        return bool(bid > self._bids[task] or tie)

    def _with(self, task: int, place: int) -> list[int]:
        path = self._full_path()
        return [*path, task] if place < 0 else [*path[:place], task, *path[place:]]

    def _full_path(self) -> list[int]:
        return self._path if self._bundle else list(self.schedule.path)

    def _working_schedule(self) -> AgentSchedule:
        """The settled schedule with the present bundle in the path."""
        settled = self.schedule
        schedule = AgentSchedule(settled.agent, settled.durations, settled.lags, settled.near, settled.deadlines)
        schedule.deadlines[list(self._late)] = NO_DEADLINE
        schedule.path = self._full_path()
        schedule.starts, schedule.finishes = settled.starts.copy(), settled.finishes.copy()
        for task in self._bundle:
            schedule.starts[task], schedule.finishes[task] = self._starts[task], self._finishes[task]
        return schedule

    def _promise(self) -> None:
        """Write down when the bundle's tasks are done on the present path."""
        if self._bundle:
            for task, start, finish in self._working_schedule().times(self._path):
                self._starts[task], self._finishes[task] = start, finish

    def _take_in(self, message: Consensus) -> None:
        """Decide by the paper's table for every task, then take over who has been heard of when."""
        theirs = np.array(message.heard)
        for task in self._waves[0]:
            bid = message.bids[task]
            action = resolve(
                self.schedule.agent, message.agent, int(self._winners[task]), message.winners[task],
                float(self._bids[task]), bid, self._heard, theirs,
            )  # fmt: skip
            if action == UPDATE:
                self._winners[task], self._bids[task] = message.winners[task], bid
                self._starts[task], self._finishes[task] = message.starts[task], message.finishes[task]
            elif action != LEAVE:
                self._forget(task)
        self._heard = np.maximum(self._heard, theirs)
        self._heard[message.agent] = message.turn

    def _forget(self, task: int) -> None:
        self._winners[task], self._bids[task] = _NOBODY, _NO_BID
        self._starts[task] = self._finishes[task] = UNKNOWN

    def _release_lost(self) -> None:
        """Drop a lost task and everything that was added to the bundle after it."""
        lost = [k for k, task in enumerate(self._bundle) if self._winners[task] != self.schedule.agent]
        if not lost:
            return
        dropped = self._bundle[lost[0] :]
        for task in dropped:
            if self._winners[task] == self.schedule.agent:
                self._forget(task)
        self._bundle = self._bundle[: lost[0]]
        self._path = [task for task in self._path if task not in dropped]
        self._late -= set(dropped)

    def _settle(self) -> None:
        """Take the wave's outcome down with common times, and go on to the next wave."""
        schedule, wave = self.schedule, self._waves.pop(0)
        schedule.deadlines[list(self._late)] = NO_DEADLINE
        for task in wave:
            if self._winners[task] != _NOBODY:
                schedule.holder[task] = self._winners[task]
                schedule.starts[task], schedule.finishes[task] = self._starts[task], self._finishes[task]
        put_in_order(schedule, self._n_agents, self._deadlines)
        self._bundle, self._path, self._late = [], [], set()
        self._exchanges = self._quiet = 0


def put_in_order(schedule: AgentSchedule, n_agents: int, deadlines: np.ndarray) -> None:
    """Time all tasks that are taken anew, in one order for all, so that near ones do not overlap.

    Of four orders that everybody can tell from what it knows (by promised start, by promised finish, by the latest
    start that its deadline, int64 (N,), leaves a task, and by deadline) the one of the least sum of lateness
    counts, then of the earliest end, then the first.
    """
    taken = np.flatnonzero(schedule.holder != _NOBODY)
    lasts = schedule.finishes - schedule.starts
    due = np.where(deadlines == NO_DEADLINE, _NEVER, deadlines)
    durations = np.zeros((len(schedule.holder), n_agents), np.int64)
    durations[taken, schedule.holder[taken]] = lasts[taken]
    best: tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray] | None = None
    for key in (schedule.starts, schedule.finishes, due - lasts, due):
        order = taken[np.lexsort((taken, schedule.starts[taken], key[taken]))]
        starts, finishes = schedule.starts.copy(), schedule.finishes.copy()
        if not time_order(order, schedule.holder[order], durations, schedule.lags, schedule.near, starts, finishes):
            continue
        late = int(np.maximum(finishes - due, 0)[taken].sum())
        found = (late, int(finishes[taken].max(initial=0)))
        if best is None or found < best[0]:
            best = found, order, starts, finishes
    if best is not None:
        _, order, starts, finishes = best
        for agent in range(n_agents):
            own = [(int(i), int(starts[i]), int(finishes[i])) for i in order if schedule.holder[i] == agent]
            schedule.note(agent, own)


def waves(lags: np.ndarray) -> list[list[int]]:
    """The tasks by the length of the longest chain of waits before them; lags int64 (N, N)."""
    depth = np.zeros(len(lags), np.int64)
    for _ in range(len(lags)):
        for i, j in np.argwhere(lags >= 0):
            depth[i] = max(depth[i], depth[j] + 1)
    return [np.flatnonzero(depth == level).tolist() for level in range(int(depth.max()) + 1)]

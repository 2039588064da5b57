"""An agent's own schedule as a simple temporal network, and where in it another task fits."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.kernels import kernel
from marl_sched.temporal_network import close, earliest_times, relax, unconstrained

UNKNOWN = -1


@kernel
def schedule_network(
    path: np.ndarray,
    agent: int,
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    deadlines: np.ndarray,
    starts: np.ndarray,
    finishes: np.ndarray,
) -> tuple[bool, np.ndarray]:
    """Whether an agent can do the tasks of `path`, int64 (K,), in that order, and their earliest starts int64 (K,).

    starts and finishes int64 (N,) are the times by which tasks are known to be taken, UNKNOWN for open ones; the
    agent's own are those it promised. It keeps to what it told others: a task of theirs that waits for one of its
    own, or is near to it and was promised later, starts as it was told. A task of its own that is new comes
    after all near ones that it knows of. Points of the network are the starts, the origin first.
    """
    count = len(path)
    own = np.zeros(len(durations), np.bool_)
    own[path] = True
    network = unconstrained(count + 1)
    for k in range(count):
        task = path[k]
        lasts = durations[task, agent]
        relax(network, k + 1, 0, 0)
        if deadlines[task] != NO_DEADLINE:
            relax(network, 0, k + 1, deadlines[task] - lasts)
        if k > 0:
            relax(network, k + 1, k, -durations[path[k - 1], agent])
        for m in range(count):
            if lags[task, path[m]] >= 0:
                relax(network, k + 1, m + 1, -durations[path[m], agent] - lags[task, path[m]])
        for other in range(len(durations)):
            if own[other] or starts[other] == UNKNOWN:
                continue
            if lags[task, other] >= 0:
                relax(network, k + 1, 0, -finishes[other] - lags[task, other])
            if lags[other, task] >= 0:
                relax(network, 0, k + 1, starts[other] - lags[other, task] - lasts)
            elif near[task, other] and lags[task, other] < 0:
                if starts[task] != UNKNOWN and starts[task] < starts[other]:
                    relax(network, 0, k + 1, starts[other] - lasts)
                else:
                    relax(network, k + 1, 0, -finishes[other])
    return close(network), earliest_times(network, 0)[1:]


@kernel
def best_place(
    path: np.ndarray,
    task: int,
    agent: int,
    durations: np.ndarray,
    lags: np.ndarray,
    near: np.ndarray,
    deadlines: np.ndarray,
    starts: np.ndarray,
    finishes: np.ndarray,
) -> tuple[int, int, int]:
    """Where in `path` the task fits best: (place, when the agent ends its work, when the task ends); -1 if nowhere.

    The earliest end of work counts, then the earliest end of the task, then the earliest place.
    """
    best, ends, done = -1, 0, 0
    longer = np.empty(len(path) + 1, np.int64)
    for place in range(len(path) + 1):
        longer[:place], longer[place], longer[place + 1 :] = path[:place], task, path[place:]
        consistent, times = schedule_network(longer, agent, durations, lags, near, deadlines, starts, finishes)
        if not consistent:
            continue
        end, own = times[-1] + durations[longer[-1], agent], times[place] + durations[task, agent]
        if best < 0 or end < ends or (end == ends and own < done):
            best, ends, done = place, end, own
    return best, ends, done


class AgentSchedule:
    """What an agent knows of a round: its own path, and of every task who has it and when.

    Attributes:
        path: its own tasks in order.
        holder: int64 (N,), who has a task as far as it knows, -1 for nobody.
        starts, finishes: int64 (N,), promised times of tasks that are taken, UNKNOWN for others.
    """

    def __init__(
        self, agent: int, durations: np.ndarray, lags: np.ndarray, near: np.ndarray, deadlines: np.ndarray
    ) -> None:
        n = len(durations)
        self.agent, self.durations, self.lags, self.near = agent, durations, lags, near
        self.deadlines = deadlines.copy()
        self.path: list[int] = []
        self.holder = np.full(n, -1, np.int64)
        self.starts, self.finishes = np.full(n, UNKNOWN, np.int64), np.full(n, UNKNOWN, np.int64)

    def ready(self, task: int) -> bool:
        """Whether the agent can do a task and all that the task waits for are known to be taken."""
        ahead = self.lags[task] >= 0
        return bool(self.durations[task, self.agent] >= 0 and (self.starts[ahead] != UNKNOWN).all())

    def place(self, task: int) -> tuple[int, int, int]:
        """`best_place` of a task in the agent's own path."""
        return best_place(
            np.array(self.path, np.int64), task, self.agent, self.durations, self.lags, self.near, self.deadlines,
            self.starts, self.finishes,
        )  # fmt: skip

    def end_of(self, task: int) -> int:
        """When a task would end that breaks a deadline: behind all that the agent has."""
        begin = int(self.finishes[self.path[-1]]) if self.path else 0
        for other in np.flatnonzero(self.starts != UNKNOWN):
            if self.lags[task, other] >= 0:
                begin = max(begin, int(self.finishes[other] + self.lags[task, other]))
            elif self.near[task, other]:
                begin = max(begin, int(self.finishes[other]))
        return begin + int(self.durations[task, self.agent])

    def times(self, path: list[int]) -> list[tuple[int, int, int]]:
        """(task, start, finish) of a path that fits, as early as it can be done."""
        _, starts = schedule_network(
            np.array(path, np.int64), self.agent, self.durations, self.lags, self.near, self.deadlines, self.starts,
            self.finishes,
        )  # fmt: skip
        return [
            (task, int(start), int(start + self.durations[task, self.agent]))
            for task, start in zip(path, starts, strict=True)
        ]

    def note(self, agent: int, timetable: list[tuple[int, int, int]]) -> None:
        """Take down that an agent does these tasks at these times."""
        for task, start, finish in timetable:
            self.holder[task], self.starts[task], self.finishes[task] = agent, start, finish
        if agent == self.agent:
            self.path = [task for task, _, _ in timetable]

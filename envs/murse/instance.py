"""A MuRSE problem: tasks for a team of robots and humans (dissertation, sections 3.2, 4.2.1 and 5.2.1).

Arrays count tasks, agents and waits from 0; files, messages and actions count tasks from 1. Robots come
before humans. A pair of task and agent whose duration is INELIGIBLE cannot be; a duration of 0 is one like any other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path

import numpy as np

from marl_sched.envs.murse.learning import CURVE, LEARNING, C, K, mean_duration, whole
from marl_sched.errors import InvalidOptionError
from marl_sched.files import write_json

SCHEMA = 2
NO_DEADLINE = -1
INELIGIBLE = -1
PROXIMITY = ("distance", "location", "none")
DURATIONS = ("deterministic", "stochastic")


@dataclass(frozen=True, kw_only=True, eq=False)
class MurseInstance:
    """Tasks, a team and its constraints; N tasks, R robots, H humans, A = R + H agents, W waits.

    Raises InvalidOptionError, which names the field, if a value cannot be.

    Attributes:
        proximity: which pairs of tasks must not overlap: at most `safety_distance` apart ("distance",
            Euclidean), at the same location ("location"), or none.
        learning: "none", "one_shot" or "exponential" (equation 5.1).
        durations: "deterministic" humans take the mean of their curve and everybody knows it; "stochastic"
            ones draw, and the team estimates.
        duration_range: least and greatest whole duration of a human, to which draws are clipped.
    """

    robot_durations: np.ndarray  # int64 (N, R), time units, or INELIGIBLE
    curves: np.ndarray  # float64 (N, H, 6), columns as in learning.CURVE, c + k = 0: ineligible
    deadlines: np.ndarray  # int64 (N,), latest finish, NO_DEADLINE: none
    waits: np.ndarray  # int64 (W, 3), sorted rows (i, j, w): task i starts at least w after task j finishes
    locations: np.ndarray  # float64 (N, 2)
    weights: np.ndarray  # float64 (N,), costs of the weighted completion time
    proximity: str = "distance"
    safety_distance: float = 1.0
    learning: str = "exponential"
    durations: str = "deterministic"
    duration_range: tuple[int, int] = (15, 100)
    n_rounds: int = 1
    map_width: float = 5.0
    task_names: tuple[str, ...] = ()  # what people call the tasks; () for no names, they then are "task 1" and so on
    agent_names: tuple[str, ...] = ()  # likewise, robots first
    noise_of: int | None = None  # the identity of another problem, whose noise this one is to meet; None: its own

    def __post_init__(self) -> None:
        """Bring the arrays to their dtypes, make them read-only, and check them."""
        for name, dtype in _ARRAYS.items():
            array: np.ndarray = np.array(getattr(self, name), dtype)
            if name == "waits":
                array = np.array(sorted(array.tolist()), dtype).reshape(-1, 3) if array.shape[1:] == (3,) else array
                array = array.reshape(0, 3) if array.size == 0 else array
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        problem = self._shape_problem() or self._option_problem() or self._value_problem() or self._wait_problem()
        if problem:
            raise InvalidOptionError(f"MuRSE instance: {problem}")

    def _shape_problem(self) -> str:
        n = self.robot_durations.shape[0]
        shapes: dict[str, tuple[int | None, ...]] = {
            "robot_durations": (n, None),
            "curves": (n, None, len(CURVE)),
            "deadlines": (n,),
            "waits": (None, 3),
            "locations": (n, 2),
            "weights": (n,),
        }
        for name, shape in shapes.items():
            got = getattr(self, name).shape
            if len(got) != len(shape) or any(e not in (None, g) for e, g in zip(shape, got, strict=True)):
                wanted = ", ".join("any" if size is None else str(size) for size in shape)
                return f"{name}: expected shape ({wanted}), got {got}"
        if n == 0:
            return "tasks: expected at least one"
        return "" if self.n_agents else "agents: expected at least one robot or human"

    def _option_problem(self) -> str:
        low, high = self.duration_range
        for name, known in (("proximity", PROXIMITY), ("learning", LEARNING), ("durations", DURATIONS)):
            if getattr(self, name) not in known:
                return f"{name}: expected one of {', '.join(known)}, got {getattr(self, name)!r}"
        for name, given, count in (
            ("task_names", self.task_names, self.n_tasks),
            ("agent_names", self.agent_names, self.n_agents),
        ):
            if given and (len(given) != count or len(set(given)) != count):
                return f"{name}: expected {count} names that differ, got {len(given)}"
        for name, good, expected in (
            ("duration_range", 1 <= low <= high, "two integers 1 <= low <= high"),
            ("n_rounds", self.n_rounds >= 1, "an integer >= 1"),
            ("safety_distance", np.isfinite(self.safety_distance) and self.safety_distance >= 0, "a number >= 0"),
            ("map_width", np.isfinite(self.map_width) and self.map_width > 0, "a number > 0"),
        ):
            if not good:
                return f"{name}: expected {expected}, got {getattr(self, name)}"
        return ""

    def _value_problem(self) -> str:
        curves = self.curves.reshape(self.n_tasks, -1)
        for name, good, expected in (
            ("robot_durations", self.robot_durations >= INELIGIBLE, "an integer >= 0, or -1: ineligible"),
            ("curves", np.isfinite(curves) & (curves >= 0), "numbers >= 0"),
            ("deadlines", (self.deadlines >= 0) | (self.deadlines == NO_DEADLINE), "an integer >= 0 or none"),
            ("locations", np.isfinite(self.locations), "finite numbers"),
            ("weights", np.isfinite(self.weights) & (self.weights >= 0), "a number >= 0"),
        ):
            if not good.all():
                i = int(np.argwhere(~good)[0][0])
                return f"tasks[{i}]: {name}: expected {expected}, got {getattr(self, name)[i].tolist()}"
        alone = np.flatnonzero(~self.eligible.any(axis=1))
        return f"tasks[{alone[0]}]: no agent is eligible" if len(alone) else ""

    def _wait_problem(self) -> str:
        for row in self.waits:
            i, j, w = (int(x) for x in row)
            if not (0 <= i < self.n_tasks and 0 <= j < self.n_tasks):
                return f"waits: task {i + 1} after task {j + 1}: expected tasks in 1..{self.n_tasks}"
            if w < 0:
                return f"waits: task {i + 1} after task {j + 1}: expected a time >= 0, got {w}"
        cycle = find_cycle(self.n_tasks, self.waits)
        return f"waits: tasks {' -> '.join(str(i + 1) for i in cycle)} wait for one another" if cycle else ""

    @property
    def n_tasks(self) -> int:
        """Number of tasks, placeholders not counted."""
        return int(self.robot_durations.shape[0])

    @property
    def n_robots(self) -> int:
        """Number of robots, agents 0..n_robots-1."""
        return int(self.robot_durations.shape[1])

    @property
    def n_humans(self) -> int:
        """Number of humans, the agents after the robots."""
        return int(self.curves.shape[1])

    @property
    def n_agents(self) -> int:
        """Robots and humans."""
        return self.n_robots + self.n_humans

    @property
    def learning_code(self) -> int:
        """The learning mode as the kernels take it."""
        return LEARNING.index(self.learning)

    @cached_property
    def eligible(self) -> np.ndarray:
        """Bool (N, A), which agents can do a task at all."""
        return np.hstack([self.robot_durations >= 0, self.curves[:, :, C] + self.curves[:, :, K] > 0])

    @cached_property
    def mean_durations(self) -> np.ndarray:
        """Int64 (N, A), durations of the first round without noise, INELIGIBLE for ineligible pairs."""
        first = np.full((self.n_tasks, self.n_humans), INELIGIBLE, np.int64)
        for i, h in np.argwhere(self.eligible[:, self.n_robots :]):
            first[i, h] = whole(mean_duration(self.curves[i, h], 0, self.learning_code), *self.duration_range)
        return np.hstack([self.robot_durations, first])

    def waits_by_task(self) -> list[list[tuple[int, int]]]:
        """Per task its waits as (task that it waits for, time), both counted from 0."""
        ahead: list[list[tuple[int, int]]] = [[] for _ in range(self.n_tasks)]
        for i, j, w in self.waits.tolist():
            ahead[i].append((j, w))
        return ahead

    @cached_property
    def lags(self) -> np.ndarray:
        """Int64 (N, N), [i, j] the time that i starts at the earliest after j finishes, -1 where i need not wait."""
        lags = np.full((self.n_tasks, self.n_tasks), -1, np.int64)
        for i, j, w in self.waits:
            lags[i, j] = max(lags[i, j], w)
        return lags

    @cached_property
    def near(self) -> np.ndarray:
        """Bool (N, N), pairs of different tasks that must not overlap in time (L_proximity, section 4.2.1)."""
        apart = np.hypot(*(self.locations[:, None] - self.locations[None]).transpose(2, 0, 1))
        if self.proximity == "none":
            near = np.zeros_like(apart, bool)
        elif self.proximity == "location":
            near = apart == 0
        else:
            near = apart <= self.safety_distance
        return near & ~np.eye(self.n_tasks, dtype=bool)

    def __repr__(self) -> str:
        """One line: sizes and identity."""
        return (
            f"MurseInstance({self.n_tasks} tasks, {self.n_robots} robots, {self.n_humans} humans, "
            f"{self.n_rounds} rounds, {self.identity:016x})"
        )

    @cached_property
    def identity(self) -> int:
        """A 64-bit hash of tasks, team and constraints: the instance's name in counter-based randomness.

        The settings (proximity, learning, durations, rounds) are left out, so that a team draws the same
        noise under each of them; so are the names.
        """
        if self.noise_of is not None:
            return self.noise_of
        digest = blake2b(repr(self.duration_range).encode(), digest_size=8)
        for name, dtype in _ARRAYS.items():
            array = getattr(self, name)
            digest.update(repr(array.shape).encode())
            digest.update(array.astype(np.dtype(dtype).newbyteorder("<")).tobytes())
        return int.from_bytes(digest.digest(), "little")

    def earliest_finishes(self, durations: np.ndarray) -> np.ndarray:
        """Int64 (N,), when each task could end if it had only its chain of waits and its fastest agent to heed.

        `durations` int64 (N, A) of every pair, those of ineligible ones are not looked at.
        """
        fastest = np.where(self.eligible, durations, np.iinfo(np.int64).max).min(axis=1)
        finish = np.zeros(self.n_tasks, np.int64)
        for i in waiting_order(self.n_tasks, self.waits):
            starts = [finish[j] + self.lags[i, j] for j in np.flatnonzero(self.lags[i] >= 0)]
            finish[i] = max(starts, default=0) + fastest[i]
        return finish

    def impossibilities(self) -> list[str]:
        """Why no schedule of any round can be feasible, one sentence per hopeless deadline; empty if none is known.

        A deadline is hopeless when it lies before the task's earliest finish with everybody at the fastest that
        they may ever be.
        """
        finish = self.earliest_finishes(self._fastest_durations())
        hopeless = np.flatnonzero((self.deadlines != NO_DEADLINE) & (finish > self.deadlines))
        return [f"task {i + 1}: deadline {self.deadlines[i]} but no finish before {finish[i]}" for i in hopeless]

    def _fastest_durations(self) -> np.ndarray:
        """Int64 (N, A), the least duration of each pair in any round."""
        if self.durations == "stochastic":
            noisy = np.any(self.curves[:, :, [1, 3, 5]], axis=2)
        else:
            noisy = np.zeros(self.curves.shape[:2], bool)
        humans = np.empty(self.curves.shape[:2], np.int64)
        for i, h in np.ndindex(humans.shape):
            best = mean_duration(self.curves[i, h], self.n_rounds - 1, self.learning_code)
            humans[i, h] = self.duration_range[0] if noisy[i, h] else whole(best, *self.duration_range)
        return np.hstack([self.robot_durations, humans])

    def as_json(self) -> dict[str, object]:
        """Plain data, one object per task, from which `reading.decode` makes the instance again; tasks count from 1."""
        names = {"agent_names": list(self.agent_names)} if self.agent_names else {}
        return {"schema": SCHEMA, "env": "murse", **self._settings(), **names, "tasks": self._tasks()}

    @property
    def called(self) -> tuple[list[str], list[str]]:
        """What tasks and agents are called: their names, or "task 1", "robot 0" and "human 1"."""
        kinds = ["robot" if a < self.n_robots else "human" for a in range(self.n_agents)]
        tasks = list(self.task_names) or [f"task {i + 1}" for i in range(self.n_tasks)]
        return tasks, list(self.agent_names) or [f"{kind} {a}" for a, kind in enumerate(kinds)]

    def save(self, path: str | Path) -> None:
        """Write `as_json` to a file, whole or not at all."""
        write_json(path, self.as_json())

    def _settings(self) -> dict[str, object]:
        names = (
            "n_robots", "n_humans", "n_rounds", "proximity", "safety_distance", "learning", "durations", "map_width",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names} | {"duration_range": list(self.duration_range)}

    def _tasks(self) -> list[dict[str, object]]:
        ahead = self.waits_by_task()
        return [
            {
                **({"name": self.task_names[i]} if self.task_names else {}),
                "robots": [None if d == INELIGIBLE else int(d) for d in self.robot_durations[i]],
                "humans": [dict(zip(CURVE, curve.tolist(), strict=True)) for curve in self.curves[i]],
                "deadline": None if self.deadlines[i] == NO_DEADLINE else int(self.deadlines[i]),
                "waits": [{"after": j + 1, "time": w} for j, w in ahead[i]],
                "location": self.locations[i].tolist(),
                "weight": float(self.weights[i]),
            }
            for i in range(self.n_tasks)
        ]


_ARRAYS: dict[str, type] = {
    "robot_durations": np.int64,
    "curves": np.float64,
    "deadlines": np.int64,
    "waits": np.int64,
    "locations": np.float64,
    "weights": np.float64,
}


def waiting_order(n_tasks: int, waits: np.ndarray) -> list[int]:
    """The tasks, those that others wait for first; tasks on a cycle of waits, and those behind one, are missing."""
    behind: list[set[int]] = [set() for _ in range(n_tasks)]
    for i, j, _ in waits.tolist():
        behind[j].add(i)
    left = [0] * n_tasks
    for others in behind:
        for i in others:
            left[i] += 1
    order: list[int] = []
    ready = [i for i in range(n_tasks) if left[i] == 0]
    while ready:
        order += ready
        freed = set()
        for j in ready:
            for i in behind[j]:
                left[i] -= 1
                if left[i] == 0:
                    freed.add(i)
        ready = sorted(freed)
    return order


def find_cycle(n_tasks: int, waits: np.ndarray) -> list[int]:
    """Tasks that wait for one another in a circle, the first one repeated at the end; empty if there is none."""
    stuck = set(range(n_tasks)) - set(waiting_order(n_tasks, waits))
    if not stuck:
        return []
    ahead = {int(k): int(j) for k, j, _ in waits if int(k) in stuck and int(j) in stuck}
    path = [min(stuck)]
    while path[-1] not in path[:-1]:
        path.append(ahead[path[-1]])
    return path[path.index(path[-1]) :]

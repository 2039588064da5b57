"""Couriers as a batched turn-based simulator, in plain NumPy: this domain shows the contract, not speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from couriers import graph
from couriers.instance import SCALES, CouriersInstance
from marl_sched.errors import IllegalActionError, InvalidOptionError, require, require_integer
from marl_sched.noise import FIRST_DOMAIN_STREAM, time_key, uniform
from marl_sched.simulation import Observation, TurnSimulator

OBJECTIVES = ("waiting", "travel")
DEFAULT_HORIZON = 12  # days
DELAY = FIRST_DOMAIN_STREAM  # stream of the extra day that a job may take, entity = job


class CouriersSimulator(TurnSimulator):
    """A batch of problems, one per env; on every day each courier that is free and there has a turn.

    A day: jobs arrive and waiting ones are cancelled; couriers choose in ascending order; the reward is minus what the
    objective counts on this day: jobs that wait, or places travelled.

    Args:
        instances: one per env.
        view, objective, horizon (days), seed, pad: as every domain has them.
        delay: probability that a job takes a day more.
    """

    unit = time_unit = "days"
    graph = graph.GRAPH

    def __init__(
        self,
        instances: Sequence[CouriersInstance],
        *,
        view: Any = None,
        objective: str = "waiting",
        horizon: int = DEFAULT_HORIZON,
        seed: int = 0,
        pad: str | None = None,
        delay: float = 0.25,
    ) -> None:
        if not instances:
            raise InvalidOptionError("instances: expected at least one")
        if not 0 <= delay <= 1:
            raise InvalidOptionError(f"delay: expected a probability in [0, 1], got {delay}")
        require("objective of couriers", objective, OBJECTIVES)
        self.horizon = require_integer("horizon", horizon, 1, 10_000, "days")
        self.instances, self.batch = list(instances), len(instances)
        self.view = graph.FullView() if view is None else view
        self.objective, self.delay = objective, delay
        jobs = SCALES[pad].jobs if pad else max(len(i.jobs) for i in instances)
        self.max_agents = SCALES[pad].couriers[1] if pad else max(len(i.couriers) for i in instances)
        self.max_actions = jobs + 1
        self.arrays = self.graph.arrays({"job": jobs + 1, "courier": self.max_agents})
        self.jobs = np.zeros((self.batch, jobs + 1), graph.JOB)
        self.couriers = np.zeros((self.batch, self.max_agents), graph.COURIER)
        self.end = np.zeros((self.batch, jobs + 1), np.int64)  # day on which a job that is taken is done
        self.until = np.zeros((self.batch, self.max_agents), np.int64)  # day from which a courier is free again
        self.sums = np.zeros((self.batch, len(OBJECTIVES)))
        self.history: list[list[tuple[int, int, int]]] = [[] for _ in instances]  # (courier, day, days), for pictures
        for name, dtype in _PER_ENV.items():
            setattr(self, name, np.zeros(self.batch, dtype))
        self._first_episodes()
        self.reset(seed=seed)

    def reset(
        self,
        envs: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[Any] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start new episodes; see TurnSimulator.reset."""
        chosen = self._next_episodes(envs, seed, instances, episodes)
        for k, b in enumerate(chosen):
            if instances is not None:
                self.instances[b] = instances[k]
            self._start(int(b))

    def _start(self, b: int) -> None:
        instance = self.instances[b]
        if len(instance.jobs) >= self.max_actions or len(instance.couriers) > self.max_agents:
            raise InvalidOptionError(f"instances[{b}]: more jobs or couriers than the padding holds")
        for array in (self.jobs, self.couriers, self.end, self.until, self.sums):
            array[b] = np.zeros((), array.dtype)
        for name in _PER_ENV:
            getattr(self, name)[b] = 0
        self.history[b] = []
        key = self._episode_key(b)
        self.episode_keys[b], self.n_agents[b] = np.uint64(key), len(instance.couriers)
        for c, courier in enumerate(instance.couriers):
            self.couriers[b, c]["there"], self.couriers[b, c]["home"] = True, courier.home
        for j, job in enumerate(instance.jobs, start=1):
            for name in ("work", "arrival", "place"):
                self.jobs[b, j][name] = getattr(job, name)
        self._begin_day(b)
        self._find_turn(b)

    def _begin_day(self, b: int) -> None:
        """Let jobs arrive, end and be cancelled; couriers come back and leave."""
        day, instance = self.time[b], self.instances[b]
        for j, job in enumerate(instance.jobs, start=1):
            mine = self.jobs[b, j]
            done = mine["taken"] and self.end[b, j] <= day
            cancelled = not mine["taken"] and job.cancelled is not None and job.cancelled <= day
            mine["there"] = job.arrival <= day and not done and not cancelled
        for c, courier in enumerate(instance.couriers):
            mine = self.couriers[b, c]
            away = courier.away is not None and courier.away[0] <= day <= courier.away[1]
            mine["available"], mine["free"] = not away, self.until[b, c] <= day
            mine["acted"], mine["choice"] = False, 0

    def free_agents(self, env_index: int) -> np.ndarray:
        """Couriers that have still to choose today, ascending."""
        couriers = self.couriers[env_index]
        able = couriers["there"] & couriers["available"] & couriers["free"] & ~couriers["acted"]
        return np.flatnonzero(able) if not self.over[env_index] else np.empty(0, np.int64)

    def step(self, actions: np.ndarray) -> None:
        """Take one turn in every env; see TurnSimulator.step."""
        actions = np.asarray(actions, np.int64)
        if actions.shape != (self.batch,) or actions.min() < 0 or actions.max() >= self.max_actions:
            raise IllegalActionError(f"actions: expected ({self.batch},) job slots in [0, {self.max_actions - 1}]")
        self.reward[:], self.elapsed[:], self.conflict[:] = 0.0, 0, False
        for b in np.flatnonzero(self.acting >= 0):
            self._choose(int(b), int(self.acting[b]), int(actions[b]))
            self._find_turn(int(b))

    def _choose(self, b: int, agent: int, slot: int) -> None:
        courier, job = self.couriers[b, agent], self.jobs[b, slot]
        courier["acted"] = True
        if slot == 0:
            return
        if not job["there"] or job["taken"] or slot in self.couriers["choice"][b]:
            self.conflict[b] = True
            return
        word = np.uint64(time_key(self.episode_keys[b], self.time[b]))
        days = int(job["work"]) + (uniform(word, DELAY, slot, 0) < self.delay)
        courier["choice"] = slot
        self.end[b, slot] = self.until[b, agent] = self.time[b] + days
        distance = abs(int(job["place"]) - int(courier["home"]))
        self.sums[b, 1] += distance
        self.history[b].append((agent, int(self.time[b]), days))
        if self.objective == "travel":
            self.reward[b] -= distance

    def _find_turn(self, b: int) -> None:
        """Let days pass until a courier can choose or the episode is over."""
        while not len(self.free_agents(b)) and not self.over[b]:
            self._end_day(b)
        self.acting[b] = -1 if self.over[b] else self.free_agents(b)[0]

    def _end_day(self, b: int) -> None:
        jobs = self.jobs[b]
        jobs["taken"][self.couriers["choice"][b][self.couriers["choice"][b] > 0]] = True
        waiting = int(np.sum(jobs["there"] & ~jobs["taken"]))
        self.sums[b, 0] += waiting
        self.time[b] += 1
        self.elapsed[b] += 1
        if self.objective == "waiting":
            self.reward[b] -= waiting
        self._begin_day(b)
        left = any(job.arrival > self.time[b] for job in self.instances[b].jobs) or bool(jobs["there"].any())
        self.terminated[b] = not left
        self.truncated[b] = left and self.time[b] >= self.horizon

    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """What each env's courier sees; see TurnSimulator.observe."""
        return self._observe(agents, self.view.reach, self.new_observation() if out is None else out)

    def observe_all(self) -> Observation:
        """The acting couriers' graphs under the full view."""
        return self._observe(self.acting, graph.FullView().reach, self.new_observation())

    def _observe(self, agents: np.ndarray, reach: int, out: Observation) -> Observation:
        for b in range(self.batch):
            present = int(self.jobs["there"][b].sum())
            arrays = {name: out[name][b, ...] for name in self.arrays}
            graph.write(self.jobs[b], self.couriers[b], int(self.time[b]), int(agents[b]), reach, present, arrays)
        return out

    @property
    def presence(self) -> Mapping[str, np.ndarray]:
        """Jobs that are there; slot 0 always is."""
        there = self.jobs["there"].copy()
        there[:, 0] = True
        return {"job": there, "courier": self.couriers["there"].copy()}

    @property
    def availability(self) -> Mapping[str, np.ndarray]:
        """Couriers that are not away."""
        return {"courier": self.couriers["available"].copy()}

    def objectives(self) -> dict[str, np.ndarray]:
        """Means per day played, float64 (B,): jobs that wait, places travelled."""
        return {name: self.sums[:, k] / np.maximum(self.time, 1) for k, name in enumerate(OBJECTIVES)}

    def snapshot(self, env_index: int) -> dict[str, np.ndarray]:
        """Copies of an env's state."""
        names = ("jobs", "couriers", "end", "until", "sums", *_PER_ENV)
        return {name: np.array(getattr(self, name)[env_index]) for name in names}


_PER_ENV = {
    "n_agents": np.int64, "acting": np.int64, "time": np.int64, "reward": np.float64, "elapsed": np.int64,
    "conflict": np.bool_, "terminated": np.bool_, "truncated": np.bool_, "episode_keys": np.uint64,
}  # fmt: skip

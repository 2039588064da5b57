"""What one deployed MuRSE agent knows, built from what it hears (marl_sched.envs.murse.telemetry).

It is a simulator's state of one row that is filled in only where the agent was told something, and a `Sight` of it.
The kernel that observes the true state reads both, so that what a deployed agent sees is equal to the simulator's
observation to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from marl_sched.envs.murse import graph, observation, telemetry
from marl_sched.envs.murse.instance import INELIGIBLE, NO_DEADLINE, MurseInstance
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NEVER, NOBODY, NOTHING, State, new_state
from marl_sched.envs.murse.views import Sight, new_sight
from marl_sched.errors import InvalidMessageError
from marl_sched.simulation import Observation


class MurseLocalState:
    """What one agent knows; see marl_sched.domain_parts.LocalState."""

    def __init__(self, frame: telemetry.Frame, agent: int) -> None:
        if not 0 <= agent < frame.n_agents:
            raise InvalidMessageError(f"agent {agent} does not exist: the team has agents 0 to {frame.n_agents - 1}")
        if frame.n_agents > frame.max_agents or frame.n_tasks > frame.max_tasks or frame.n_robots > frame.n_agents:
            raise InvalidMessageError("frame: more tasks or agents than the padding holds, or more robots than agents")
        self._frame, self._agent = frame, agent
        who = "team" if frame.shared else f"agent/{agent}"
        self._hearers: dict[str, Callable[[bytes], None]] = {
            telemetry.NOW: self._hear_now,
            f"{who}/{telemetry.TASKS}": self._hear_tasks,
            f"{who}/{telemetry.ESTIMATES}": self._hear_estimates,
            f"{who}/{telemetry.COMMITMENTS}": self._hear_commitments,
        }
        self.channels = tuple(sorted(self._hearers))
        self._state = new_state(1, frame.max_tasks, frame.max_agents, 1)
        row = self._state.rows
        row["n_tasks"], row["n_agents"], row["n_robots"] = frame.n_tasks, frame.n_agents, frame.n_robots
        row["high"], row["acting"], row["n_rounds"] = frame.longest, NOBODY, 1
        self._state.tasks["agent"] = NOBODY
        self._state.agents["last_task"], self._state.agents["free_at"] = NOTHING, NEVER
        self._forget_estimates()
        self._sight = new_sight(self._state)
        self._sight.heard[agent] = True
        sizes = {"task": frame.max_tasks + 2, "agent": frame.max_agents, "location": frame.max_tasks}
        spec = graph.graph_spec(frame.simplification)
        arrays = spec.arrays({**sizes, "decision": frame.max_tasks + 2})
        self._observation: Observation = {name: array.empty(1) for name, array in arrays.items()}
        written: Observation = {"aug": np.zeros((0, 0, 0), np.int8), "aug_attributes": np.zeros((0,) * 4, np.float32)}
        written |= self._observation
        self._arrays = graph.Arrays(*[written[name] for name in graph.Arrays._fields])
        self._simulator: MurseSimulator | None = None

    @property
    def state(self) -> State:
        """What the agent was told, as a simulator's state of one row."""
        return self._state

    @property
    def sight(self) -> Sight:
        """How much of that it knows now."""
        return self._sight

    @property
    def agent(self) -> int:
        """Its index."""
        return self._agent

    def hear(self, channel: str, payload: bytes) -> None:
        """Take in a channel's newest payload; see LocalState.hear."""
        if channel not in self._hearers:
            raise InvalidMessageError(f"{channel}: not a channel that agent {self._agent} hears")
        self._hearers[channel](payload)

    def _hear_now(self, payload: bytes) -> None:
        said, row = telemetry.decode(payload, telemetry.Now), self._state.rows
        row["round"], row["clock"], row["time"], row["origin"] = said.round, said.clock, said.time, 0
        row["acting"] = NOBODY if said.over else self._agent

    def _hear_tasks(self, payload: bytes) -> None:
        said, n, state = telemetry.decode(payload, telemetry.Tasks), self._frame.n_tasks, self._state
        seen = {told.task for told in said.tasks}
        for told in said.tasks:
            numbers = [told.x, told.y, told.weight]
            waits = [other for other, _ in told.waits]
            if max([told.task, told.place, *waits]) >= n or not np.isfinite(numbers).all() or told.weight < 0:
                raise InvalidMessageError(f"task {told.task}: beyond the {n} that there are, or no finite numbers")
            if not seen.issuperset(told.near) or len(seen) != len(said.tasks):
                raise InvalidMessageError(f"task {told.task}: told twice, or near to a task out of sight")
        self._sight.seen[:] = False
        for told in said.tasks:
            self._sight.seen[told.task] = True
            record = state.tasks[0, told.task]
            for name in ("x", "y", "weight", "deadline", "place"):
                record[name] = getattr(told, name)
            state.lags[0, told.task], state.near[0, told.task] = -1, False
            for other, lag in told.waits:
                state.lags[0, told.task, other] = lag
            state.near[0, told.task, told.near] = True

    def _forget_estimates(self) -> None:
        pairs = self._state.pairs[0]
        pairs[:] = 0
        pairs["true"] = pairs["planned"] = self._state.base[0] = INELIGIBLE

    def _hear_estimates(self, payload: bytes) -> None:
        said, frame = telemetry.decode(payload, telemetry.Estimates), self._frame
        for task, estimates in said.tasks:
            for told in estimates:
                if task >= frame.n_tasks or told.agent >= frame.n_agents:
                    raise InvalidMessageError(f"task {task} by agent {told.agent}: there is no such task or agent")
                if not np.isfinite([told.mean, told.spread]).all() or min(told.mean, told.spread) < 0:
                    raise InvalidMessageError(f"task {task} by agent {told.agent}: expected finite numbers >= 0")
        self._forget_estimates()
        for task, estimates in said.tasks:
            for told in estimates:
                pair = self._state.pairs[0, task, told.agent]
                pair["true"] = pair["planned"] = self._state.base[0, task, told.agent] = told.planned
                pair["mean"], pair["spread"], pair["repetitions"] = told.mean, told.spread, told.repetitions

    def _hear_commitments(self, payload: bytes) -> None:
        said, frame = telemetry.decode(payload, telemetry.Commitments), self._frame
        state, sight = self._state, self._sight
        agents = [told.agent for told in said.agents]
        if self._agent not in agents or max([*agents, *(taken.agent for taken in said.taken)]) >= frame.n_agents:
            raise InvalidMessageError(f"agents beyond the {frame.n_agents} that there are, or without this one")
        tasks = [taken.task for taken in said.taken]
        last = [told.last_task for told in said.agents]
        if max([*tasks, *last]) >= frame.n_tasks or len(set(tasks)) != len(tasks):
            raise InvalidMessageError(f"a task beyond the {frame.n_tasks} that there are, or taken twice")
        if not np.isfinite([(told.x, told.y) for told in said.agents]).all():
            raise InvalidMessageError("agents: expected finite places")
        sight.heard[:] = False
        state.agents["last_task"], state.agents["free_at"] = NOTHING, NEVER
        for heard in said.agents:
            sight.heard[heard.agent] = True
            state.agents["last_task"][0, heard.agent] = heard.last_task
            if heard.last_task != NOTHING:
                record = state.tasks[0, heard.last_task]
                record["x"], record["y"] = heard.x, heard.y
        if self._agent in said.free:
            state.agents["free_at"][0, self._agent] = 0
        sight.known[:], sight.start[:], sight.finish[:] = False, 0, 0
        state.tasks["agent"] = NOBODY
        state.rows["dispatched"] = len(said.taken)
        for k, taken in enumerate(said.taken):
            state.order[0, k] = taken.task
            record = state.tasks[0, taken.task]
            for name in ("agent", "committed", "start", "finish"):
                record[name] = getattr(taken, name)
            sight.known[taken.task] = True
            sight.start[taken.task], sight.finish[taken.task] = taken.start, taken.finish

    def observe(self) -> Observation:
        """The agent's observation; its arrays are written anew by every call."""
        observation.observe_known(self._state, self._agent, self._sight, self._arrays)
        return self._observation

    def simulator(self) -> MurseSimulator | None:
        """What the agent knows as a simulator, whose turn it is to decide; see LocalState.simulator.

        None under a view that hides something, and before tasks and estimates have been heard. Durations are those
        that the team counts on in this round.
        """
        n, a, state = self._frame.n_tasks, self._frame.n_agents, self._state
        planned = state.pairs["planned"][0, :n, :a]
        if not self._frame.shared or not (planned >= 0).any(axis=1).all():
            return None
        if self._simulator is None:
            self._simulator = MurseSimulator([self._instance(planned)], mode=self._frame.mode, pad=None)
        known: Any = self._simulator.state
        names = ("round", "clock", "time", "dispatched")
        for name in names:
            known.rows[name] = state.rows[name]
        known.rows["acting"] = self._agent
        for name in ("x", "y", "weight", "deadline", "place", "agent", "committed", "start", "finish"):
            known.tasks[name] = state.tasks[name][:, :n]
        known.agents[:] = state.agents[:, :a]
        known.pairs[:], known.base[:] = state.pairs[:, :n, :a], state.base[:, :n, :a]
        known.lags[:], known.near[:] = state.lags[:, :n, :n], state.near[:, :n, :n]
        known.order[:] = state.order[:, :n]
        return self._simulator

    def _instance(self, planned: np.ndarray) -> MurseInstance:
        """The problem as the agent was told it, humans as robots of the durations that they are expected to take."""
        n, tasks, lags = self._frame.n_tasks, self._state.tasks[0], self._state.lags[0]
        waits = [(i, j, lags[i, j]) for i, j in np.argwhere(lags[:n, :n] >= 0)]
        return MurseInstance(
            robot_durations=planned,
            curves=np.zeros((n, 0, 6)),
            deadlines=np.where(tasks["deadline"][:n] < 0, NO_DEADLINE, tasks["deadline"][:n]),
            waits=np.array(waits, np.int64).reshape(-1, 3),
            locations=np.stack([tasks["x"][:n], tasks["y"][:n]], axis=1),
            weights=tasks["weight"][:n],
            proximity=self._frame.proximity,
            safety_distance=self._frame.safety_distance,
            duration_range=(1, self._frame.longest),
        )

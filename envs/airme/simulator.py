"""AirME as a batched turn-based simulator: the arrays, their setting up, and the calls into the kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from marl_sched.compiled import entry
from marl_sched.envs.airme import dynamics, graph
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType, FailureModel, failure_table
from marl_sched.envs.airme.features import graph_spec
from marl_sched.envs.airme.instance import SCALES, AirmeInstance
from marl_sched.envs.airme.state import (
    BEGUN,
    CREW,
    MISSED,
    OBJECTIVES,
    PLANE,
    REPAIRED,
    ROW,
    SCHEMES,
    UNDECIDED,
    Rules,
    State,
)
from marl_sched.envs.airme.views import FullView, View
from marl_sched.errors import IllegalActionError, InvalidOptionError, require, require_integer
from marl_sched.simulation import Observation, SavedState, TurnSimulator

DEFAULT_HORIZON = 720
MOST_HOURS = 1_000_000  # of an episode: books are kept for every hour


class AirmeSimulator(TurnSimulator):
    """A batch of AirME instances, one per row; see TurnSimulator for the turn-taking and its attributes.

    `limits` int64 (B, 3) holds (reach, comm, staleness) of each row's running episode.

    Args:
        instances: one AirmeInstance per row. Types are told apart by their names; see `fleet_types`.
        view: what acting crews see.
        objective: "profit", "revenue" or "availability", the reward of an hour.
        horizon: hours of an episode, its truncation.
        seed: of the first episode's noise.
        pad: a scale whose largest instance sets the padding; None pads to the largest of `instances`.
        scheme: "full", "skip" (action 0 ends the hour's decisions) or "single" (one decision an hour),
            section 6.3.1.
        failure: "density" as published, or "hazard".
        stop_share: an episode terminates when this share of planes is broken; None: never.
        record_timeline: keep what every plane did in every hour, for rendering.

    Raises InvalidOptionError or UnknownNameError for options outside their domain.
    """

    unit = time_unit = "hours"

    def __init__(
        self,
        instances: Sequence[AirmeInstance],
        *,
        view: View | None = None,
        objective: str = "profit",
        horizon: int = DEFAULT_HORIZON,
        seed: int = 0,
        pad: str | None = None,
        scheme: str = "full",
        failure: FailureModel = "density",
        stop_share: float | None = None,
        record_timeline: bool = False,
    ) -> None:
        self._check(instances, objective, horizon, pad, scheme, stop_share)
        self.instances = list(instances)
        self.types = fleet_types(self.instances)
        self.view = view if view is not None else FullView()
        self.objective, self.scheme, self.horizon, self.failure = objective, scheme, horizon, failure
        self.batch = len(self.instances)
        self.limits = np.zeros((self.batch, 3), np.int64)
        self._no_limits = np.tile(np.array(FullView().limits), (self.batch, 1))
        planes = SCALES[pad].max_planes if pad else max(i.n_planes for i in self.instances)
        crews = SCALES[pad].crews[1] if pad else max(i.n_crews for i in self.instances)
        self.max_actions, self.max_agents = planes + 1, crews
        self.graph = graph_spec(len(self.types))
        self.arrays = self.graph.arrays({"plane": planes + 1, "crew": crews})
        self.state = _new_state(self.batch, planes, crews, horizon, self.view.memory, record_timeline)
        self.rules = Rules(
            usage=np.array([kind.usage for kind in self.types]),
            failure=np.zeros((len(self.types), 1, 0)),
            objective=OBJECTIVES.index(objective),
            scheme=SCHEMES.index(scheme),
            horizon=int(horizon),
            stop_share=float(stop_share or 0.0),
        )
        self._link()
        self._first_episodes()
        self.reset(seed=seed)

    @staticmethod
    def _check(
        instances: Sequence[AirmeInstance],
        objective: str,
        horizon: int,
        pad: str | None,
        scheme: str,
        stop_share: float | None,
    ) -> None:
        if not instances:
            raise InvalidOptionError("instances: expected at least one")
        require("objective of airme", objective, OBJECTIVES)
        require("scheme", scheme, SCHEMES)
        if pad is not None:
            require("scale of airme", pad, SCALES)
        require_integer("horizon", horizon, 1, MOST_HOURS, "hours")
        if stop_share is not None and not 0 < stop_share <= 1:
            raise InvalidOptionError(f"stop_share: expected a share in (0, 1] or None, got {stop_share}")

    def _link(self) -> None:
        """Make the attributes views of the state's rows, and the failure table reach the instances' counters."""
        rows = self.state.rows
        self.n_agents, self.acting, self.time = rows["n_crews"], rows["acting"], rows["time"]
        self.reward, self.elapsed, self.conflict = rows["reward"], rows["elapsed"], rows["conflict"]
        self.terminated, self.truncated = rows["terminated"], rows["truncated"]
        self.episode_keys = rows["episode"]
        self._cover_counters(self.instances)

    def reset(
        self,
        envs: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[AirmeInstance] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start new episodes; see TurnSimulator.reset."""
        chosen = self._next_episodes(envs, seed, instances, episodes)
        if instances is not None:
            for b, instance in zip(chosen, instances, strict=True):
                self.instances[b] = instance
        self._cover_counters([self.instances[b] for b in chosen])
        for b in chosen:
            self._start(int(b))

    def _cover_counters(self, instances: Sequence[AirmeInstance]) -> None:
        """Make the failure table reach every counter that an episode of these instances can reach."""
        longest = max((int(max(i.hours.max(), i.landings.max())) for i in instances), default=0) + self.horizon
        if self.rules.failure.shape[2] <= longest:
            table = failure_table(self.types, longest, self.failure)
            self.rules = self.rules._replace(failure=table)

    def _start(self, b: int) -> None:
        instance, state = self.instances[b], self.state
        known = [kind.name for kind in self.types]
        if not _are_known(instance, self.types):
            raise InvalidOptionError(
                f"instances[{b}]: expected aircraft types of {', '.join(known)} as the simulator was made with, "
                f"got {', '.join(kind.name for kind in instance.types)}"
            )
        kinds = np.array([known.index(kind.name) for kind in instance.types])
        n_planes, n_crews = instance.n_planes, instance.n_crews
        if n_planes >= self.max_actions or n_crews > self.max_agents:
            raise InvalidOptionError(
                f"instances[{b}]: {n_planes} planes and {n_crews} crews exceed the padding of "
                f"{self.max_actions - 1} planes and {self.max_agents} crews"
            )
        planes = state.planes[b]
        planes[:] = 0
        planes["crew"] = planes["chosen"] = -1
        planes["kind"][1 : n_planes + 1] = kinds[instance.kind]
        for name in ("income", "hours", "landings", "broken"):
            planes[name][1 : n_planes + 1] = getattr(instance, name)
        state.crews[b] = 0
        state.crews["choice"][b] = UNDECIDED
        state.rows[b] = 0
        row = state.rows[b]
        row["n_planes"], row["n_crews"] = n_planes, n_crews
        row["total_income"] = instance.income.sum()
        row["episode"] = self._episode_key(b)
        self.limits[b] = self.view.limits_in(row["episode"])
        state.series[b] = 0.0
        state.work[b] = 0
        if len(state.timeline):
            state.timeline[b] = state.jobs[b] = 0
        if state.past.shape[1]:
            state.past[b] = planes
        if len(state.private_memory_at):
            state.private_memory_at[b] = -1

    def load_state(self, saved: SavedState) -> None:
        """Go back to a saved state; see TurnSimulator.load_state. The aircraft types must be this simulator's."""
        if not all(_are_known(instance, self.types) for instance in saved.instances):
            raise InvalidOptionError("load_state: the saved fleets have other aircraft types than this simulator's")
        super().load_state(saved)

    def step(self, actions: np.ndarray) -> None:
        """Take one turn in every row; see TurnSimulator.step."""
        self._play(_step(), actions, (self.batch,))

    def play_hour(self, choices: np.ndarray) -> None:
        """Play one hour in every row with an action for each crew, int64 (B, C), as in section 6.2.4.

        Actions of busy crews are ignored. Afterwards `acting` is -1 in rows whose crews are all busy.
        """
        self._play(_play_hour(), choices, (self.batch, self.max_agents))

    def _play(self, kernel: Callable[..., int], actions: np.ndarray, shape: tuple[int, ...]) -> None:
        """Hand actions to `step` or `play_hour`; IllegalActionError, and no change, for one that is no slot."""
        actions = np.ascontiguousarray(actions, np.int64)
        if actions.shape != shape:
            raise IllegalActionError(f"actions: expected shape {shape}, got {actions.shape}")
        outside = kernel(self.state, self.rules, actions)
        if outside >= 0:
            bad = actions.ravel()[outside]
            raise IllegalActionError(f"action {bad}: expected a plane's slot in [0, {self.max_actions - 1}]")

    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """The graph each row's crew sees under the simulator's view; see TurnSimulator.observe."""
        return self._observe(agents, self.limits, out)

    def observe_all(self) -> Observation:
        """The acting crews' graphs under the full view."""
        return self._observe(self.acting, self._no_limits, None)

    def _observe(self, agents: np.ndarray, limits: np.ndarray, out: Observation | None) -> Observation:
        out = self.new_observation() if out is None else out
        arrays = graph.Arrays(*[out[name] for name in graph.Arrays._fields])
        graph.observe(self.state, self.rules.usage, np.ascontiguousarray(agents, np.int64), limits, arrays)
        return out

    def free_agents(self, env_index: int) -> np.ndarray:
        """Crews that have still to act in this hour."""
        n = self.n_agents[env_index]
        free = (self.state.crews["plane"][env_index, :n] == 0) & (
            self.state.crews["choice"][env_index, :n] == UNDECIDED
        )
        return np.flatnonzero(free) if not self.over[env_index] else np.empty(0, np.int64)

    def objectives(self) -> dict[str, np.ndarray]:
        """Means over the hours played, float64 (B,): profit, revenue and availability (M1 at the horizon)."""
        hours = np.maximum(self.time, 1)
        return {name: self.state.rows["sums"][:, k] / hours for k, name in enumerate(OBJECTIVES)}

    def agent_figures(self) -> dict[str, np.ndarray]:
        """What every crew did so far, float64 (B, C); see TurnSimulator.agent_figures.

        utilisation and idle: shares of hours in repair and free; idle_with_work: share of hours free while a broken
        plane stood unattended; repairs: begun.
        """
        there = np.arange(self.max_agents) < self.n_agents[:, None]
        hours = np.maximum(self.time, 1)[:, None]
        work = np.where(there[:, :, None], self.state.work, np.nan)
        busy = work[:, :, REPAIRED] / hours
        return {
            "utilisation": busy,
            "idle": 1.0 - busy,
            "idle_with_work": work[:, :, MISSED] / hours,
            "repairs": work[:, :, BEGUN],
        }

    def snapshot(self, env_index: int) -> dict[str, np.ndarray]:
        """Copies of a row's books, planes and crews."""
        return {name: getattr(self.state, name)[env_index].copy() for name in ("rows", "planes", "crews")}


def fleet_types(instances: Sequence[AirmeInstance]) -> tuple[AircraftType, ...]:
    """The aircraft types of several fleets, each once: in this order observations hold their one-hot.

    A type is known by its name, wherever it stands in a file. Where any of the published ones flies both are there,
    in their published order, so that what was trained on the two finds them where they were; all others follow by
    name. Raises InvalidOptionError for a name that stands for two different types.
    """
    found: dict[str, AircraftType] = {}
    for b, instance in enumerate(instances):
        for kind in instance.types:
            if found.setdefault(kind.name, kind) != kind:
                raise InvalidOptionError(f"instances[{b}]: aircraft type {kind.name!r} is another one elsewhere")
    published = {kind.name: kind for kind in PUBLISHED_TYPES}
    first = [found.get(name, kind) for name, kind in published.items()] if found.keys() & published.keys() else []
    return (*first, *(found[name] for name in sorted(found.keys() - published.keys())))


def _are_known(instance: AirmeInstance, types: Sequence[AircraftType]) -> bool:
    return set(instance.types) <= set(types)


def _new_state(batch: int, planes: int, crews: int, horizon: int, staleness: int, timeline: bool) -> State:
    slots = planes + 1
    memory = (batch, crews, slots) if staleness else (0, 0, 0)
    return State(
        rows=np.zeros(batch, ROW),
        planes=np.zeros((batch, slots), PLANE),
        crews=np.zeros((batch, crews), CREW),
        series=np.zeros((batch, horizon, 3)),
        timeline=np.zeros((batch, horizon, slots) if timeline else (0, 0, 0), np.uint8),
        jobs=np.zeros((batch, horizon, crews) if timeline else (0, 0, 0), np.int32),
        work=np.zeros((batch, crews, 3), np.int64),
        past=np.zeros((batch, staleness + 1 if staleness else 0, slots), PLANE),
        private_memory=np.zeros(memory, PLANE),
        private_memory_at=np.full(memory, -1, np.int64),
    )


def example() -> tuple[State, Rules]:
    """A state and rules of the types that those of every simulator have, to compile kernels for."""
    rules = Rules(np.zeros(1), np.zeros((1, 1, 1)), objective=0, scheme=0, horizon=1, stop_share=0.0)
    return _new_state(1, 1, 1, 1, 0, timeline=False), rules


@cache
def _step() -> Callable[..., int]:
    return entry(dynamics.step, *example(), np.zeros(1, np.int64))


@cache
def _play_hour() -> Callable[..., int]:
    return entry(dynamics.play_hour, *example(), np.zeros((1, 1), np.int64))

"""The delivery ward as a batched turn-based simulator; the kernels stand in marl_sched.envs.ward.dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from marl_sched.envs.ward import dynamics, graph
from marl_sched.envs.ward.features import GRAPH
from marl_sched.envs.ward.instance import QUARTERS, SCALES, STAGES, WardInstance
from marl_sched.envs.ward.views import FullView, View
from marl_sched.errors import IllegalActionError, InvalidOptionError, require, require_integer
from marl_sched.simulation import Observation, TurnSimulator

DEFAULT_HORIZON = 24  # hours
MOST_HOURS = 100_000


class WardSimulator(TurnSimulator):
    """A batch of wards, one per row; see TurnSimulator for the turn-taking and its attributes.

    In every quarter of an hour each nurse who is not busy with taking over a patient has a turn, in ascending order.

    Args:
        instances: one WardInstance per row.
        view: what acting nurses see.
        objective: "cost" or "census"; the reward is minus what a quarter of an hour adds to it.
        horizon: hours of an episode, its truncation. Episodes never end before.
        seed: of the first episode's noise.
        pad: a scale whose largest instance sets the padding; None pads to the largest of `instances`.
        record_timeline: keep who lay in which bed in every quarter of an hour, for rendering.

    Raises InvalidOptionError or UnknownNameError for options outside their domain.
    """

    unit, time_unit = "hours", "quarter-hours"
    graph = GRAPH

    def __init__(
        self,
        instances: Sequence[WardInstance],
        *,
        view: View | None = None,
        objective: str = dynamics.OBJECTIVES[0],
        horizon: int = DEFAULT_HORIZON,
        seed: int = 0,
        pad: str | None = None,
        record_timeline: bool = False,
    ) -> None:
        if not instances:
            raise InvalidOptionError("instances: expected at least one")
        require("objective of ward", objective, dynamics.OBJECTIVES)
        self.horizon = require_integer("horizon", horizon, 1, MOST_HOURS, "hours")
        self.instances, self.batch = list(instances), len(instances)
        self.view = FullView() if view is None else view
        self.objective = objective
        bounds = None if pad is None else SCALES[require("scale of ward", pad, SCALES)]
        patients = bounds.patients[1] if bounds else max(len(i.patients) for i in instances)
        beds = bounds.beds * bounds.sections if bounds else max(len(i.beds) for i in instances)
        self.max_agents = bounds.nurses[1] if bounds else max(len(i.nurses) for i in instances)
        self.max_actions = patients + 1
        self.arrays = self.graph.arrays({"patient": patients + 1, "nurse": self.max_agents, "bed": beds})
        self.rules = dynamics.Rules(dynamics.OBJECTIVES.index(objective), QUARTERS * self.horizon)
        shown = (self.batch, self.rules.end, beds) if record_timeline else (0, 0, 0)
        self.state = new_state(self.batch, patients, self.max_agents, beds, shown)
        self._link()
        self._first_episodes()
        self.reset(seed=seed)

    def _link(self) -> None:
        """Make the attributes views of the state's rows."""
        rows = self.state.rows
        self.n_agents, self.acting, self.time = rows["n_nurses"], rows["acting"], rows["time"]
        self.reward, self.elapsed, self.conflict = rows["reward"], rows["elapsed"], rows["conflict"]
        self.terminated, self.truncated = rows["terminated"], rows["truncated"]
        self.episode_keys = rows["episode"]

    def reset(
        self,
        envs: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[WardInstance] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start new episodes; see TurnSimulator.reset."""
        chosen = self._next_episodes(envs, seed, instances, episodes)
        if instances is not None:
            for b, instance in zip(chosen, instances, strict=True):
                self.instances[b] = instance
        for b in chosen:
            self._start(int(b))

    def _start(self, b: int) -> None:
        instance, state = self.instances[b], self.state
        sizes = {"patients": state.patients.shape[1] - 1, "nurses": self.max_agents, "beds": state.beds.shape[1]}
        for name, most in sizes.items():
            given = len(getattr(instance, name))
            if given > most:
                raise InvalidOptionError(f"instances[{b}]: {given} {name} exceed the padding of {most}")
        for array in state:
            if len(array):
                array[b] = np.zeros((), array.dtype)
        row, patients, nurses = state.rows[b], state.patients[b], state.nurses[b]
        key = self._episode_key(b)
        row["episode"] = key
        row["n_patients"], row["n_nurses"] = len(instance.patients), len(instance.nurses)
        row["n_beds"] = len(instance.beds)
        patients["bed"] = patients["nurse"] = dynamics.NOBODY
        for slot, patient in enumerate(instance.patients, start=1):
            patients[slot]["stage"] = STAGES.index(patient.stage)
            for name in ("arrival", "first", "high_risk", "section"):
                patients[slot][name] = getattr(patient, name)
        nurses["home"][: len(instance.nurses)] = instance.nurses
        state.beds["section"][b, : len(instance.beds)] = instance.beds
        dynamics.begin(state, self.rules, b)

    def step(self, actions: np.ndarray) -> None:
        """Take one turn in every row; see TurnSimulator.step."""
        actions = np.ascontiguousarray(actions, np.int64)
        if actions.shape != (self.batch,):
            raise IllegalActionError(f"actions: expected shape ({self.batch},), got {actions.shape}")
        outside = dynamics.step(self.state, self.rules, actions)
        if outside >= 0:
            raise IllegalActionError(
                f"action {actions[outside]}: expected a patient's slot in [0, {self.max_actions - 1}]"
            )

    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """The graph each row's nurse sees under the simulator's view; see TurnSimulator.observe."""
        return self._observe(agents, self.view, out)

    def observe_all(self) -> Observation:
        """The acting nurses' graphs under the full view."""
        return self._observe(self.acting, FullView(), None)

    def _observe(self, agents: np.ndarray, view: View, out: Observation | None) -> Observation:
        out = self.new_observation() if out is None else out
        arrays = graph.Arrays(*[out[name] for name in graph.Arrays._fields])
        graph.observe(self.state, np.array(agents, np.int64), np.array(view.limits), arrays)
        return out

    def free_agents(self, env_index: int) -> np.ndarray:
        """Nurses that have still to choose in this quarter of an hour."""
        nurses = self.state.nurses[env_index, : self.n_agents[env_index]]
        free = (nurses["busy"] == 0) & (nurses["choice"] == dynamics.UNDECIDED)
        return np.flatnonzero(free) if not self.over[env_index] else np.empty(0, np.int64)

    @property
    def progress(self) -> np.ndarray:
        """Whole hours that have passed, int64 (B,)."""
        return self.time // QUARTERS

    @property
    def presence(self) -> Mapping[str, np.ndarray]:
        """Patients that are there; slot 0 always is."""
        there = self.state.patients["there"].copy()
        there[:, 0] = True
        return {"patient": there}

    def objectives(self) -> dict[str, np.ndarray]:
        """Means over the hours played, float64 (B,): cost of waiting and of missing care per hour, patients there.

        `discharged` is how many patients an hour left the ward.
        """
        hours = np.maximum(self.time, 1) / QUARTERS
        rows = self.state.rows
        return {name: rows[name] / hours for name in (*dynamics.OBJECTIVES, "discharged")}

    def agent_figures(self) -> dict[str, np.ndarray]:
        """What every nurse did so far, float64 (B, N); see TurnSimulator.agent_figures.

        utilisation and idle: shares of time with and without a patient; takeovers: patients admitted or taken over;
        overloaded: share of time in which her patients needed more than she can give.
        """
        there = np.arange(self.max_agents) < self.n_agents[:, None]
        quarters = np.maximum(self.time, 1)[:, None]
        work = np.where(there[:, :, None], self.state.work, np.nan)
        busy = work[:, :, 0] / quarters
        return {
            "utilisation": busy,
            "idle": 1.0 - busy,
            "takeovers": work[:, :, 1],
            "overloaded": work[:, :, 2] / quarters,
        }

    def snapshot(self, env_index: int) -> dict[str, np.ndarray]:
        """Copies of a row's books, patients, nurses and beds."""
        return {name: getattr(self.state, name)[env_index].copy() for name in ("rows", "patients", "nurses", "beds")}


def new_state(batch: int, patients: int, nurses: int, beds: int, shown: tuple[int, int, int]) -> dynamics.State:
    """A state of zeros; `shown` is the shape of the timeline."""
    return dynamics.State(
        rows=np.zeros(batch, dynamics.ROW),
        patients=np.zeros((batch, patients + 1), dynamics.PATIENT),
        nurses=np.zeros((batch, nurses), dynamics.NURSE),
        beds=np.zeros((batch, beds), dynamics.BED),
        work=np.zeros((batch, nurses, 3), np.int64),
        timeline=np.zeros(shown, np.uint8),
    )

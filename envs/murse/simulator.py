"""MuRSE as a batched turn-based simulator: the arrays' setting up and the calls into the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from marl_sched.envs.murse import dynamics, graph, observation, rules
from marl_sched.envs.murse.agent_books import executed_by_agent
from marl_sched.envs.murse.generate import SCALES
from marl_sched.envs.murse.instance import DURATIONS, PROXIMITY, MurseInstance
from marl_sched.envs.murse.state import NOBODY, load_instance, new_state
from marl_sched.envs.murse.views import FullView, LocalView
from marl_sched.errors import IllegalActionError, InvalidOptionError, require, require_integer
from marl_sched.simulation import Observation, TurnSimulator

DEFAULT_HORIZON = 10
MOST_ROUNDS = 100_000  # of an episode: results are kept for every round
DEFAULT_MULTIPLIER = 2.0


class MurseSimulator(TurnSimulator):
    """A batch of MuRSE instances, one per row; see TurnSimulator for the turn-taking and its attributes.

    An episode is an instance's rounds, one after the other; `time` runs on over the rounds.

    Args:
        instances: one MurseInstance per row.
        view: what acting agents see.
        objective: "makespan" or "weighted" (completion time), what the reward charges, per round.
        horizon: rounds of an episode, if the instance has that many.
        seed: of the first episode's noise.
        pad: a scale whose largest instance sets the padding; None pads to the largest of `instances`.
        mode: "plan" builds a round's schedule on estimates and then executes it; "online" decides in real time.
        picking: which of several free agents decides first (section 4.2.2): "first", "mean_unscheduled",
            "min_unscheduled" or "mean_all", on estimated durations, ties by index.
        rewards: "round" pays minus the objective when a round ends; "decision" pays every change of it
            (section 3.4.1); both charge an infeasible round at least the longest round. "published" is equation
            5.2 as it stands, in which failing can pay better than finishing.
        multiplier: of the worst case in the charge for an infeasible round (C_i of equation 5.2).
        divisor: of all changes but the last under "decision" (D of section 3.4.1).
        simplification: "sparse" or "distance" edges between tasks, see marl_sched.envs.murse.graph.
        durations, proximity: replace the instances' own settings.

    Raises InvalidOptionError or UnknownNameError for options outside their domain.
    """

    unit, time_unit = "rounds", "time units"

    def __init__(
        self,
        instances: Sequence[MurseInstance],
        *,
        view: FullView | LocalView | None = None,
        objective: str = "makespan",
        horizon: int = DEFAULT_HORIZON,
        seed: int = 0,
        pad: str | None = None,
        mode: str = "plan",
        picking: str = "first",
        rewards: str = "round",
        multiplier: float = DEFAULT_MULTIPLIER,
        divisor: float = 1.0,
        simplification: str = "sparse",
        durations: str | None = None,
        proximity: str | None = None,
    ) -> None:
        if not instances:
            raise InvalidOptionError("instances: expected at least one")
        require_integer("horizon", horizon, 1, MOST_ROUNDS, "rounds")
        for name, value in (("multiplier", multiplier), ("divisor", divisor)):
            if not 1.0 <= value < float("inf"):
                raise InvalidOptionError(f"{name}: expected a number >= 1, got {value}")
        require("simplification of murse", simplification, graph.SIMPLIFICATIONS)
        self._settings: dict[str, Any] = {}
        for name, setting, known in (("durations", durations, DURATIONS), ("proximity", proximity, PROXIMITY)):
            if setting is not None:
                self._settings[name] = require(f"{name} of murse", setting, known)
        self.rules = rules.Rules(
            mode=_code("mode", mode, rules.MODES),
            picking=_code("picking strategy", picking, rules.PICKING),
            objective=_code("objective of murse", objective, rules.OBJECTIVES),
            rewards=_code("rewards of murse", rewards, rules.REWARDS),
            multiplier=float(multiplier),
            divisor=float(divisor),
        )
        self.view = view if view is not None else FullView()
        self.objective, self.mode, self.horizon, self.simplification = objective, mode, horizon, simplification
        self.instances = [self._with_settings(instance) for instance in instances]
        self.batch = len(self.instances)
        self._allocate(pad, graph.SIMPLIFICATIONS.index(simplification))
        self._link()
        self._loaded: list[MurseInstance | None] = [None] * self.batch
        self._first_episodes()
        self.reset(seed=seed)

    def _allocate(self, pad: str | None, simplification: int) -> None:
        """Set the padding, the arrays and the observation's layout."""
        if pad is not None:
            scale = SCALES[require("scale of murse", pad, SCALES)]
            tasks, agents = scale.tasks[1], scale.agents[1]
        else:
            tasks, agents = max(i.n_tasks for i in self.instances), max(i.n_agents for i in self.instances)
        self._max_tasks, self.max_actions, self.max_agents = tasks, tasks + 2, agents
        self.state = new_state(self.batch, tasks, agents, self.horizon)
        self.graph = graph.graph_spec(simplification)
        sizes = {"task": tasks + 2, "agent": agents, "location": tasks, "decision": tasks + 2}
        self.arrays = self.graph.arrays(sizes)
        self._no_reverse = (np.zeros((0, 0, 0), np.int8), np.zeros((0, 0, 0, 0), np.float32))

    def _link(self) -> None:
        """Make the attributes views of the state's rows, which hold the data of all instances."""
        self._loaded = list(self.instances)
        rows = self.state.rows
        self.n_agents, self.acting, self.time = rows["n_agents"], rows["acting"], rows["time"]
        self.reward, self.elapsed, self.conflict = rows["reward"], rows["elapsed"], rows["conflict"]
        self.terminated, self.truncated = rows["terminated"], rows["truncated"]
        self.episode_keys = rows["episode"]

    def _with_settings(self, instance: MurseInstance) -> MurseInstance:
        return replace(instance, **self._settings) if self._settings else instance

    def reset(
        self,
        envs: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[MurseInstance] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start new episodes; see TurnSimulator.reset."""
        chosen = self._next_episodes(envs, seed, instances, episodes)
        for b, instance in zip(chosen, instances or [], strict=False):
            self.instances[b] = self._with_settings(instance)
        for b in chosen:
            self._load(int(b))
        dynamics.begin_rows(self.state, self.rules, chosen.astype(np.int64))

    def _load(self, b: int) -> None:
        """Bring a row's instance into the arrays if it is not there yet, and name the episode's noise."""
        instance = self.instances[b]
        if self._loaded[b] is not instance:
            if instance.n_tasks > self._max_tasks or instance.n_agents > self.max_agents:
                raise InvalidOptionError(
                    f"instances[{b}]: {instance.n_tasks} tasks and {instance.n_agents} agents exceed the padding of "
                    f"{self._max_tasks} tasks and {self.max_agents} agents"
                )
            load_instance(self.state, b, instance, min(instance.n_rounds, self.horizon))
            self._loaded[b] = instance
        self.state.rows["episode"][b] = self._episode_key(b)

    def step(self, actions: np.ndarray) -> None:
        """Take one turn in every row; see TurnSimulator.step."""
        actions = np.asarray(actions, np.int64)
        if actions.shape != (self.batch,):
            raise IllegalActionError(f"actions: expected shape {(self.batch,)}, got {actions.shape}")
        if actions.min() < 0 or actions.max() >= self.max_actions:
            bad = int(actions.min()) if actions.min() < 0 else int(actions.max())
            raise IllegalActionError(f"target {bad}: expected a task's slot in [0, {self.max_actions - 1}]")
        dynamics.step(self.state, self.rules, actions)

    def play_round(self, env_index: int, tasks: np.ndarray, agents: np.ndarray) -> None:
        """Execute a whole schedule as this round's plan in one row, whatever was dispatched so far.

        tasks and agents int64 (K,) are the pairs in order of dispatch, counted from 0, each task at most once and
        each pair eligible; K below the number of tasks leaves the round stuck. Only in `plan` mode. Raises
        IllegalActionError for anything else.
        """
        instance, tasks, agents = self.instances[env_index], np.asarray(tasks, np.int64), np.asarray(agents, np.int64)
        if self.mode != "plan":
            raise IllegalActionError("play_round: a whole schedule can only be given in plan mode")
        if self.acting[env_index] == NOBODY:
            raise IllegalActionError("play_round: the episode is over, call reset()")
        inside = (tasks >= 0) & (tasks < instance.n_tasks) & (agents >= 0) & (agents < instance.n_agents)
        if not inside.all() or not instance.eligible[tasks, agents].all():
            raise IllegalActionError("play_round: expected eligible pairs of a task and an agent of this instance")
        if len(np.unique(tasks)) != len(tasks):
            raise IllegalActionError("play_round: a task is dispatched twice")
        dynamics.play_round(self.state, self.rules, env_index, tasks, agents)

    def dispatchable(self, env_index: int, task: int, agent: int) -> bool:
        """Whether an agent could in truth commit to a task, counted from 0, at this decision epoch."""
        return bool(dynamics.dispatchable(self.state, env_index, task, agent))

    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """The graph each row's agent sees under the simulator's view; see TurnSimulator.observe."""
        return self._observe(agents, self.view.limits, out)

    def observe_all(self) -> Observation:
        """The acting agents' graphs under the full view."""
        return self._observe(self.acting, FullView().limits, None)

    def _observe(self, agents: np.ndarray, limits: tuple[float, float], out: Observation | None) -> Observation:
        out = self.new_observation() if out is None else out
        reverse: Observation = dict(zip(("aug", "aug_attributes"), self._no_reverse, strict=True))
        arrays = graph.Arrays(*[out[name] if name in out else reverse[name] for name in graph.Arrays._fields])
        observation.observe(self.state, self.rules, np.asarray(agents, np.int64), *limits, arrays)
        return out

    def free_agents(self, env_index: int) -> np.ndarray:
        """Agents that have still to act at this decision epoch, in turn order as things stand."""
        if self.over[env_index]:
            return np.empty(0, np.int64)
        free_at = self.state.agents["free_at"][env_index, : self.n_agents[env_index]]
        free = np.flatnonzero(free_at <= self.state.rows["clock"][env_index])
        keys = [dynamics.preference(self.state, self.rules.picking, env_index, int(agent)) for agent in free]
        return free[np.argsort(keys, kind="stable")]

    @property
    def length(self) -> np.ndarray:
        """Int64 (B,), rounds of each env's episode: those of its instance, at most `horizon`."""
        return self.state.rows["n_rounds"].astype(np.int64)

    @property
    def progress(self) -> np.ndarray:
        """Int64 (B,), rounds that have ended."""
        return self.state.rows["round"].astype(np.int64)

    def objectives(self) -> dict[str, np.ndarray]:
        """Means over the rounds that have ended, float64 (B,), conflicts summed; 0 before the first has ended.

        makespan and weighted are adjusted: an infeasible round counts with the worst case, the largest sum of one
        agent's durations over all tasks (times the sum of weights).
        """
        rounds = self.per_round()
        ended = np.maximum(self.state.rows["round"], 1)
        sums = {name: np.nansum(rounds[name], axis=1) for name in ("makespan", "weighted", "feasible", "conflicts")}
        return {name: total if name == "conflicts" else total / ended for name, total in sums.items()}

    def per_round(self) -> dict[str, np.ndarray]:
        """Measures of each round, name -> float64 (B, horizon), NaN where a round has not ended.

        As `objectives`; `makespan_feasible` is NaN in infeasible rounds too.
        """
        rounds, weights = self.state.rounds, self.state.tasks["weight"].sum(axis=1)[:, None]
        ended = np.arange(self.horizon) < self.state.rows["round"][:, None]
        feasible = rounds["feasible"]
        measures = {
            "feasible": feasible,
            "makespan": np.where(feasible, rounds["makespan"], rounds["worst"]),
            "makespan_feasible": np.where(feasible, rounds["makespan"], np.nan),
            "weighted": np.where(feasible, rounds["weighted"], rounds["worst"] * weights),
            "conflicts": rounds["conflicts"],
        }
        return {name: np.where(ended, values, np.nan) for name, values in measures.items()}

    def agent_figures(self) -> dict[str, np.ndarray]:
        """What every robot and human did, float64 (B, A), means over the ended rounds; see TurnSimulator.agent_figures.

        utilisation, idle: shares of the rounds' makespans at work and not; waiting: share before the agent's last task
        and not at work; tasks; tardiness: by how much its tasks ended after their deadlines in all; late: how many did.
        Of a round that got stuck, what was done of it counts.
        """
        ended = np.maximum(self.state.rows["round"].astype(np.float64), 1.0)[:, None]
        sums = executed_by_agent(self.state, self.max_agents)
        there = np.arange(self.max_agents) < self.n_agents[:, None]
        span = np.maximum(sums.pop("span"), 1.0)[:, None]
        busy = sums.pop("busy") / span
        shares = {"utilisation": busy, "idle": 1.0 - busy, "waiting": sums.pop("last") / span - busy}
        figures = shares | {name: total / ended for name, total in sums.items()}
        return {name: np.where(there, values, np.nan) for name, values in figures.items()}

    def round_results(self, env_index: int) -> np.ndarray:
        """A copy of the ended rounds' results, state.ROUND (n,)."""
        return self.state.rounds[env_index, : self.state.rows["round"][env_index]].copy()

    def snapshot(self, env_index: int) -> dict[str, np.ndarray]:
        """Copies of a row's state, without its instance's constants."""
        names = ("rows", "tasks", "agents", "pairs", "filters", "order", "private_memory", "rounds", "executed")
        return {name: getattr(self.state, name)[env_index].copy() for name in names}


def _code(what: str, name: str, known: tuple[str, ...]) -> int:
    return known.index(require(what, name, known))

"""The TorchRL environment that training plays on, and what its workers need to make one.

Beside what `SchedulingTorchRL` gives, the tensordict holds

    progress     (B,)            int64    how far the episode has come, in the domain's unit
    central      nested          the observation's arrays under the full view, for a critic or a teacher; optional
    costs        (B, n_actions)  float64  what a teacher says that each choice costs (agents.base); optional
    memory       (B, size)       float32  what the acting agent remembers, for a recurrent policy; optional
    remembered   (B, size)       float32  what it remembers after its decision, written by the policy with the action

An episode is cut (`truncated`) when its length has passed, which the curriculum gives at the row's reset. Everything
random is named by numbers (which episode of the run a row plays, counter-based noise), so that what a row plays depends
on nothing but its number among all rows of the run, whichever process holds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded

from marl_sched.agents.base import CostScheduler
from marl_sched.agents.networks.network import MEMORY
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import Domain
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.problem import Problem
from marl_sched.simulation import SavedState
from marl_sched.train.curriculum import EpisodeLength

CENTRAL, COSTS, REMEMBERED = "central", "costs", "remembered"


class InstanceSource:
    """The instances of a run: of `rows` rows, row b's episode n plays instance (n rows + b) // episodes.

    An instance depends on the problem's seed and split, on its number and on its scale, and scales take turns.
    """

    def __init__(self, problem: Problem, scales: Sequence[str], *, rows: int, episodes: int = 1) -> None:
        self._of_scale = [problem.but(scale=scale) for scale in scales]
        self._rows, self._episodes = rows, episodes

    def __call__(self, row: int, count: int) -> Any:
        """The instance that a row plays in its episode `count`."""
        number = (count * self._rows + row) // self._episodes
        return self._of_scale[number % len(self._of_scale)].instance(number)


@dataclass(frozen=True, kw_only=True)
class TrainingTask:
    """What a run plays; it can be sent to a worker.

    Attributes:
        problem: the conditions, in the split "train", which neither validation nor evaluation meets. Its scale is the
            largest of `scales`, and its horizon is longer than any episode, so that a state at a cut has a value.
        scales: of the instances, in turn.
        rows: episodes at once, over all workers.
        episodes: rows that play the same instance.
        length: of episodes.
        turns: turns of a row in an update, None where an update is a whole episode. Rows then play on from update to
            update, and their first episodes are cut at different times, so that from then on every part of an episode
            is in every update.
        central: give the full view beside the agents' own.
        teacher: name of a CostScheduler that is asked in every turn; "": nobody is.
        memory: numbers that an agent carries from decision to decision (PolicyNetwork's `memory_size`), 0: none.
        skip: episodes of each row that are left out, as those that a run had begun before it was stopped.
    """

    problem: Problem
    scales: Sequence[str]
    rows: int
    episodes: int = 1
    length: EpisodeLength
    turns: int | None = None
    central: bool = False
    teacher: str = ""
    memory: int = 0
    skip: int = 0

    def environment(self, first: int = 0, rows: int | None = None) -> TrainingEnv:
        """The environment of rows `first` to `first + rows - 1`, None: of all."""
        return TrainingEnv(self, first, self.rows if rows is None else rows)


class TrainingEnv(SchedulingTorchRL):
    """Rows of a run; see the module's page.

    Attributes:
        task: what is played.
        episode_length: of the episodes that begin next, where an update is a whole episode; else the curriculum's.
    """

    changing: ClassVar[tuple[str, ...]] = (*SchedulingTorchRL.changing, "_cut", "_steps", "_memory")

    def __init__(self, task: TrainingTask, first: int, rows: int) -> None:
        self.task, self._first_row, problem = task, first, task.problem
        self.episode_length = task.length(0)
        self._steps, self._resumes = 0, False  # steps of every row; whether the next reset begins nothing
        self._cut = np.zeros(rows, np.int64)  # where each row's episode is cut, in the domain's unit
        self._memory = torch.zeros(rows, 0, task.memory)  # (B, max_agents, size), empty at the start of an episode
        self._teacher = cost_teacher(task.teacher, problem.domain) if task.teacher else None
        source = InstanceSource(problem, task.scales, rows=task.rows, episodes=task.episodes)
        super().__init__(
            problem.domain,
            batch_size=rows,
            scale=problem.scale,
            source=lambda row, count: source(first + row, count),
            view=problem.view,
            objective=problem.objective,
            horizon=problem.horizon,
            seed=problem.seed,
            split=problem.split,
            **problem.options,
        )

    def _make_specs(self) -> None:
        super()._make_specs()
        batch = self.batch_size
        self.observation_spec["progress"] = Unbounded(batch, dtype=torch.int64)
        if self.task.central:
            names = list(self.simulator.arrays)
            self.observation_spec[CENTRAL] = Composite(
                {n: self.observation_spec[n].clone() for n in names}, shape=batch
            )
        if self._teacher is not None:
            shape = (*batch, self.simulator.max_actions)
            self.observation_spec[COSTS] = Unbounded(shape, dtype=torch.float64)
        self._memory = torch.zeros(*batch, self.simulator.max_agents, self.task.memory)
        if self.task.memory:
            self.observation_spec[MEMORY] = Unbounded((*batch, self.task.memory), dtype=torch.float32)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._count += self.task.skip

    def _find_instances(self) -> None:
        super()._find_instances()
        self._first, self._stride = self._first + self._first_row, np.full_like(self._stride, self.task.rows)

    def _start(self, rows: np.ndarray) -> None:
        fresh = self._count < self.task.skip  # a row's first episode
        super()._start(rows)
        self._memory = torch.where(torch.from_numpy(rows)[:, None, None], 0.0, self._memory)
        if self.task.turns is None:
            self._cut[rows] = self.episode_length
            return
        length = self.task.length(self._steps // self.task.turns)
        number = self._first_row + np.arange(len(rows))
        staggered = np.maximum(length * (number + 1) // self.task.rows, 1)
        self._cut[rows] = np.where(fresh, staggered, length)[rows]

    def state_arrays(self) -> dict[str, np.ndarray]:
        """Where the rows stand, as arrays for a checkpoint; instances are named by the rows' counts of episodes."""
        simulator = {f"simulator.{name}": _as_bytes(a) for name, a in self.simulator.save_state().arrays.items()}
        own = {"count": self._count.copy(), "cut": self._cut.copy(), "memory": self._memory.numpy().copy()}
        return {**simulator, **own, "steps": np.array([self._steps])}

    def load_arrays(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from `state_arrays`, in an environment that was made for the same task: the next reset of all rows
        gives the present turn and begins nothing.
        """
        live = self.simulator.live_arrays()
        arrays = {name: _from_bytes(state[f"simulator.{name}"], array) for name, array in live.items()}
        self._count, self._cut = state["count"].copy(), state["cut"].copy()
        self._memory, self._steps = torch.from_numpy(state["memory"].copy()), int(state["steps"][0])
        if (self._count < self.task.skip).any():  # saved before the first episode began
            return
        instances = tuple(self._instances(range(len(self._count)), self._count))
        self.simulator.load_state(SavedState(type(self.simulator).__name__, arrays, instances))
        self._resumes = True

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        if self._resumes and (tensordict is None or tensordict.get("_reset", None) is None):
            self._resumes = False
            return self.current()
        return super()._reset(tensordict, **options)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._steps += 1
        remembered = tensordict.get(REMEMBERED, None)
        if remembered is not None:
            acting = torch.from_numpy(np.flatnonzero(self.simulator.acting >= 0))
            agents = torch.from_numpy(self.simulator.acting)[acting]
            self._memory[acting, agents] = remembered.detach().cpu()[acting]
        return super()._step(tensordict)

    def _turn_entries(self) -> dict[str, Any]:
        out: dict[str, Any] = super()._turn_entries()
        progress = self.simulator.progress
        cut = torch.from_numpy((progress >= self._cut)[:, None])
        out["progress"] = torch.from_numpy(progress.copy())
        out["truncated"] = (out["truncated"] | cut) & ~out["terminated"]
        out["done"] = out["terminated"] | out["truncated"]
        if self.task.central:
            central = self.simulator.observe_all()
            central[ACTION_MASK] = central[ACTION_MASK] != 0
            out[CENTRAL] = {name: torch.from_numpy(array) for name, array in central.items()}
        if self._teacher is not None:
            out[COSTS] = torch.from_numpy(self._teacher.costs(self.simulator, self._mask.astype(np.int8)))
        if self.task.memory:
            agents = torch.from_numpy(self.simulator.acting).clamp(min=0)
            out[MEMORY] = self._memory[torch.arange(len(agents)), agents]
        return out


def cost_teacher(name: str, domain: Domain) -> CostScheduler:
    """The scheduler of that name; InvalidOptionError for one that cannot say what choices cost."""
    teacher = create_scheduler(name, domain)
    if not isinstance(teacher, CostScheduler):
        raise InvalidOptionError(
            f"train: algorithm.teacher: expected a scheduler that works out what every choice costs, got {name}"
        )
    return teacher


def _as_bytes(array: np.ndarray) -> np.ndarray:
    """An array of any type, records included, as uint8; what pads a record's fields is 0."""
    plain = np.zeros(array.shape, array.dtype)
    if array.dtype.names is None:
        plain[...] = array
    for name in array.dtype.names or ():
        plain[name] = array[name]
    return np.frombuffer(plain.tobytes(), np.uint8).copy()


def _from_bytes(saved: np.ndarray, like: np.ndarray) -> np.ndarray:
    """The array that `_as_bytes` saved, with the shape and type of `like`; InvalidOptionError for another size."""
    if saved.nbytes != like.nbytes:
        raise InvalidOptionError(
            f"checkpoint: expected {like.nbytes} bytes of the simulator's state, got {saved.nbytes}"
        )
    return np.frombuffer(saved.tobytes(), like.dtype).reshape(like.shape)

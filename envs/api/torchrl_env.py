"""TorchRL: a native batched environment at the granularity of decisions.

    env = SchedulingTorchRL("airme", batch_size=1024, view="local")
    rollout = env.rollout(100, break_when_any_done=False)    # random legal choices

One step takes one turn in every row. The tensordict holds the acting agents' observations, one entry per array
of the problem graph (see marl_sched.graph), and

    action       (B,)    int64    an action
    acting       (B,)    int64    the agent whose turn it is, -1 where the episode is over
    uniform      (B,)    float64  in [0, 1), with which a policy that samples picks for the acting agent; counter-based
                                  (TurnSimulator.policy_noise)
    elapsed      (B,)    int64    simulated time that the last step let pass, the exponent of a semi-Markov discount
    conflict     (B,)    bool     the last choice was legal in its agent's view and impossible in truth
    illegal      (B,)    bool     the last choice was one that the mask forbade, so that its agent did nothing
    reward       (B, 1)  float64  team reward of that time
    done, terminated, truncated  (B, 1) bool

`action_mask` is bool here, as TorchRL's masked distributions want it. The action spec looks at the mask of the turn
(LegalActions), so `rollout` without a policy, `rand_action` and `Collector(env, None)` choose legal actions, with and
without transforms. SerialEnv and ParallelEnv sample from a spec of their own that knows no mask; what they choose
wrongly does nothing and is marked `illegal`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from marl_sched.domain import Domain
from marl_sched.envs.api.options import OF_DOMAIN, DefaultScale, as_problem
from marl_sched.envs.api.sampling import idle_illegal
from marl_sched.envs.api.saving import SavedEnvironment, SavesState
from marl_sched.envs.api.torchrl_actions import CurrentMask, LegalActions
from marl_sched.errors import IllegalActionError, InvalidOptionError
from marl_sched.graph import ACTION_MASK, ArraySpec
from marl_sched.noise import Split
from marl_sched.problem import as_instance

_CPU = torch.device("cpu")

InstanceSource = Callable[[int, int], Any]
"""(row, number of the row's episode from 0) -> the instance to play, or its file."""


class SchedulingTorchRL(SavesState, EnvBase):
    """A batch of rows of a domain as a TorchRL environment; the module's page lists the tensordict's entries.

    Without `instances` and `source`, row b plays instance b of the seed and split (marl_sched.noise) in all its
    episodes: by default "train", whose instances and noise `marl-sched evaluate` never meets. A row's first episode
    is number 0, as in the other environment APIs, and every reset goes on to the next. Rows that share an instance
    take turns in counting, and with a source all rows do, so that no two rows ever play the same episode.

    Args:
        domain: a registered domain or its name.
        batch_size: number of rows B; may be left out where `instances` are given.
        scale: of generated instances, and whose largest instance sets the padding; by default the domain's smallest.
            None pads to `instances`.
        instances: one per row, or files of such.
        source: gives a row's instance at each of its resets, and once more when the environment is made.
        view: what an acting agent sees, as every domain's simulator takes it; None is the domain's default.
        objective: what the reward follows; None is the domain's default.
        horizon: length of an episode in the domain's unit; None is the domain's default.
        seed: of instances and noise; `set_seed` sets another, for each row from its next reset on. None draws one
            from the operating system's entropy. Random actions follow `torch.manual_seed`, as everywhere in TorchRL.
        split: "train", "validation" or "test".
        device: where tensors live; the simulator runs on the CPU.
        options: further options of the domain's simulator; unknown ones raise TypeError.

    Attributes:
        problem: what is played, an instance for each row; `set_seed` puts another in its place.
        simulator: the TurnSimulator of all rows.
    """

    batch_locked = True
    changing: ClassVar[tuple[str, ...]] = ("problem", "_count")

    def __init__(
        self,
        domain: str | Domain,
        *,
        batch_size: int | None = None,
        scale: str | DefaultScale | None = OF_DOMAIN,
        instances: Sequence[Any] | None = None,
        source: InstanceSource | None = None,
        view: Any = None,
        objective: str | None = None,
        horizon: int | None = None,
        seed: int | None = None,
        split: Split = "train",
        device: torch.device | str = "cpu",
        **options: Any,
    ) -> None:
        _check(batch_size, instances, source)
        rows = len(instances) if instances is not None else int(batch_size or 1)
        super().__init__(device=torch.device(device), batch_size=torch.Size([rows]))
        self.problem = as_problem(
            domain,
            scale=scale,
            instances=instances,
            count=rows,
            seed=seed,
            options=options,
            view=view,
            objective=objective,
            horizon=horizon,
            split=split,
        )
        self.domain, self._source = self.problem.domain, source
        self._set_seed(self.problem.seed)
        self.simulator = self.problem.simulator_of(self._instances(range(rows), 0))
        self._legal = CurrentMask(np.ones((rows, self.simulator.max_actions), bool))
        self._allowed, self._illegal = np.zeros(rows, np.int64), np.zeros(rows, bool)
        self._scratch = self.simulator.new_observation()
        dtypes = {name: _torch_dtype(s.dtype) for name, s in self.simulator.arrays.items()} | {ACTION_MASK: torch.bool}
        self._layout = [(name, (rows, *s.shape), dtypes[name]) for name, s in self.simulator.arrays.items()]
        self._make_specs()

    def __repr__(self) -> str:
        """One line: the class, the rows and the problem."""
        return f"{type(self).__name__}({self.batch_size[0]} envs, {self.problem!r}, {self.device})"

    def _make_specs(self) -> None:
        batch = self.batch_size
        arrays = {name: _array_spec(spec, batch) for name, spec in self.simulator.arrays.items()}
        arrays[ACTION_MASK] = Binary(shape=(*batch, self.simulator.max_actions), dtype=torch.bool)
        self.observation_spec = Composite(
            **arrays,
            acting=Bounded(-1, self.simulator.max_agents - 1, batch, dtype=torch.int64),
            uniform=Bounded(0.0, 1.0, batch, dtype=torch.float64),
            elapsed=Unbounded(batch, dtype=torch.int64),
            conflict=Binary(shape=batch, dtype=torch.bool),
            illegal=Binary(shape=batch, dtype=torch.bool),
            shape=batch,
        ).to(self.device)
        self.action_spec = LegalActions(self.simulator.max_actions, batch, self.device, current=self._legal)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float64, device=self.device)
        done = {name: Binary(shape=(*batch, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(**done, shape=batch).to(self.device)

    @property
    def _mask(self) -> np.ndarray:
        """The actions that are legal now, bool (B, n_actions)."""
        return self._legal.legal

    def _set_seed(self, seed: int | None) -> None:
        self.problem = self.problem.but(seed=seed)
        self._count = np.full(self.batch_size[0], -1, np.int64)  # of each row's running episode
        self._find_instances()

    def _find_instances(self) -> None:
        """The instances that the seed's rows play, and how rows that share one take turns in counting episodes."""
        if self._source is None:
            self._first, self._stride = _turns([instance.identity for instance in self.problem.instances])
        else:
            self._first, self._stride = np.arange(self.batch_size[0]), np.full(self.batch_size[0], self.batch_size[0])

    def load_state(self, saved: SavedEnvironment) -> None:
        """Return to a saved state; see SavesState. `current` gives the tensordict with which to go on."""
        seed = self.problem.seed
        super().load_state(saved)
        if self.problem.seed != seed:
            self._find_instances()
        self.current()  # for the mask

    def _instances(self, rows: Sequence[int] | np.ndarray, count: int | np.ndarray) -> list[Any]:
        if self._source is None:
            return [self.problem.instances[b] for b in rows]
        counts = np.broadcast_to(count, len(rows))
        return [as_instance(self.domain, self._source(int(b), int(n))) for b, n in zip(rows, counts, strict=True)]

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        """Start new episodes in the rows marked `_reset`, in all if nothing is marked."""
        rows = np.ones(self.batch_size[0], bool)
        marked = None if tensordict is None else tensordict.get("_reset", None)
        if marked is not None:
            rows = marked.reshape(self.batch_size).cpu().numpy()
        self._start(rows)
        return self._tensordict(self._observed())

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Start new episodes in the rows that are done, as EnvBase does, and look again in those rows alone."""
        rows = tensordict.get("done").reshape(self.batch_size).cpu().numpy()
        if not rows.any():
            return tensordict
        self._start(rows)
        self.simulator.observe(np.where(rows, self.simulator.acting, -1), self._scratch)
        self._illegal[rows] = False
        self._mask[rows] = self._scratch[ACTION_MASK][rows] != 0
        index = torch.from_numpy(np.flatnonzero(rows))
        entries = self._turn_entries()
        for name, _, _ in self._layout:
            seen = tensordict.get(name).cpu().clone()  # the finished step keeps its own tensors
            seen[index] = torch.from_numpy(self._scratch[name])[index].to(seen.dtype)
            entries[name] = seen
        return tensordict.update(self._tensordict(entries))

    def _start(self, envs: np.ndarray) -> None:
        """Begin the next episode of `envs`, bool (B,)."""
        self._count[envs] += 1
        self.simulator.reset(
            envs,
            seed=self.problem.seed,
            instances=self._instances(np.flatnonzero(envs), self._count[envs]),
            episodes=self.problem.episode_numbers((self._first + self._count * self._stride)[envs]),
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Take a turn in every row; IllegalActionError names the first row whose choice lies outside the space."""
        simulator = self.simulator
        actions = tensordict.get("action").cpu().numpy()
        outside = idle_illegal(self._mask, actions, simulator.acting, self._allowed, self._illegal)
        if outside >= 0:
            agent = self.domain.agent_name(int(simulator.acting[outside]))
            highest = simulator.max_actions - 1
            raise IllegalActionError(
                f"row {outside}: {agent}: action {actions[outside]}: expected one in [0, {highest}]"
            )
        simulator.step(self._allowed)
        return self._tensordict(self._observed() | {"reward": _column(simulator.reward)})

    def current(self) -> TensorDictBase:
        """The tensordict of the present turn, as `reset` and `step` return it: where to go on after `load_state`."""
        return self._tensordict(self._observed())

    def _observed(self) -> dict[str, torch.Tensor]:
        """Everything but the reward, in fresh tensors."""
        simulator = self.simulator
        out = {name: torch.empty(shape, dtype=dtype) for name, shape, dtype in self._layout}
        # The kernels write masks as int8: the same memory under another name.
        arrays = {
            name: (tensor.view(torch.int8) if name == ACTION_MASK else tensor).numpy() for name, tensor in out.items()
        }
        simulator.observe(simulator.acting, arrays)
        np.copyto(self._mask, out[ACTION_MASK].numpy())
        return out | self._turn_entries()

    def _turn_entries(self) -> dict[str, torch.Tensor]:
        """Who acts and with which uniform, what the last step let happen and who is done, in fresh tensors."""
        simulator, out = self.simulator, {}
        out["acting"] = torch.from_numpy(simulator.acting.copy())
        out["uniform"] = torch.from_numpy(simulator.policy_noise(simulator.acting))
        out["elapsed"] = torch.from_numpy(simulator.elapsed.copy())
        out["conflict"] = torch.from_numpy(simulator.conflict.copy())
        out["illegal"] = torch.from_numpy(self._illegal.copy())
        out["terminated"] = _column(simulator.terminated)
        out["truncated"] = _column(simulator.truncated)
        out["done"] = out["terminated"] | out["truncated"]
        return out

    def _tensordict(self, entries: dict[str, torch.Tensor]) -> TensorDict:
        out = TensorDict(entries, self.batch_size, device=_CPU)
        return out if self.device == _CPU else out.to(self.device)


def _check(batch_size: int | None, instances: Any, source: Any) -> None:
    """Raise InvalidOptionError where the options of the constructor contradict each other."""
    if instances is None and (batch_size is None or batch_size < 1):
        raise InvalidOptionError(f"batch_size: expected at least 1 row, got {batch_size}")
    if instances is not None and batch_size not in (None, len(instances)):
        raise InvalidOptionError(f"instances: expected one per row ({batch_size}), got {len(instances)}")
    if instances is not None and source is not None:
        raise InvalidOptionError("source: expected either instances or a source of them, got both")


def _turns(identities: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """For each row how many rows before it, and how many in all, have the same instance, int64 (B,) each."""
    _, index, counts = np.unique(np.array(identities, np.uint64), return_inverse=True, return_counts=True)
    order = np.argsort(index, kind="stable")
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    first = np.empty(len(index), np.int64)
    first[order] = np.arange(len(index)) - starts[index[order]]
    return first, counts[index]


def _column(values: np.ndarray) -> torch.Tensor:
    """A row's value as (B, 1), the shape that TorchRL's losses expect, on its own memory."""
    return torch.from_numpy(values.copy()).unsqueeze(-1)


def _torch_dtype(dtype: np.dtype) -> torch.dtype:
    return torch.from_numpy(np.empty(0, dtype)).dtype


def _array_spec(spec: ArraySpec, batch: torch.Size) -> TensorSpec:
    shape, dtype = torch.Size([*batch, *spec.shape]), _torch_dtype(spec.dtype)
    if np.isinf(spec.low) or np.isinf(spec.high):
        return Unbounded(shape, dtype=dtype)
    return Bounded(spec.low, spec.high, shape, dtype=dtype)

"""Sampling turns: whole batches of instances in lock-step, one forward pass for the acting agents of all rows.

Two ways to cut experience into updates. `EpisodeCollector` plays whole episodes from the start; rows that
end early are masked. `SegmentCollector` plays a fixed number of turns in every row and goes on from there in
the next update; a row that reaches its episode's length is observed once more, for the value of what
would have followed, and begins a new instance.

Both play on the TorchRL environment. Everything random is named by numbers (which episode of the run a row
plays, counter-based noise), so a collector's state is small: each row's episode and what has been chosen in
it so far. Resuming replays the choices.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from marl_sched.domain import Domain
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.noise import instance_generator

Act = Callable[[dict[str, Tensor], np.ndarray], tuple[Tensor, Tensor]]
"""(observations, uniforms float64 (B,)) -> actions int64 (B,) and their log-probabilities float32 (B,)."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """T turns of B rows, and the state that the last turn led to.

    Attributes:
        observation: what acting agents saw, name -> (T + 1, B, ...).
        central: the same under the full view; the same object where the view is full.
        actions: int64 (T, B).
        log_probs: float32 (T, B), of the actions under the policy that chose them.
        rewards, elapsed: float64 and int64 (T, B).
        times: int64 (T + 1, B), simulated time at each turn.
        agents: int64 (T + 1, B), whose turn it is, -1 where nobody's.
        valid: bool (T + 1, B), a turn that was taken and counts; what the others hold is meaningless.
        alive: bool (T + 1, B), the state has a future; true at a cut, where no turn is valid.
        length: episode length in simulated time.
    """

    observation: dict[str, Tensor]
    central: dict[str, Tensor]
    actions: Tensor
    log_probs: Tensor
    rewards: Tensor
    elapsed: Tensor
    times: Tensor
    agents: Tensor
    valid: Tensor
    alive: Tensor
    length: int

    @property
    def reward_rate(self) -> float:
        """Reward per unit of simulated time over all valid turns: M1 of the sampling policy."""
        valid = self.valid[:-1]
        return float(self.rewards[valid].sum() / max(self.time, 1))

    @property
    def time(self) -> int:
        """Simulated time that passed in valid turns, over all rows."""
        return int(self.elapsed[self.valid[:-1]].sum())

    @property
    def decisions(self) -> int:
        """Number of valid turns."""
        return int(self.valid[:-1].sum())


class InstanceSource:
    """The instances of a run: of `rows` rows, row b's episode n plays instance (n rows + b) // episodes.

    An instance depends on (seed, its number) and on its scale, and scales take turns. All are of the split "train",
    which neither validation nor evaluation meets.
    """

    def __init__(self, domain: Domain, scales: Sequence[str], *, seed: int, rows: int, episodes: int = 1) -> None:
        self._domain, self._scales, self._seed = domain, tuple(scales), seed
        self._rows, self._episodes = rows, episodes

    def __call__(self, row: int, count: int) -> Any:
        """The instance that a row plays in its episode `count`."""
        number = (count * self._rows + row) // self._episodes
        rng = instance_generator(self._seed, number, "train")
        return self._domain.generate(self._scales[number % len(self._scales)], rng)


class Collector(Protocol):
    """What the training loop asks for."""

    env: SchedulingTorchRL

    def collect(self, act: Act, length: int) -> Rollout:
        """Play with `act`; episodes that begin now have that length."""

    def state(self) -> dict[str, np.ndarray]:
        """What a resumed run needs to go on."""

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a saved state; the collector must be new."""


class _Recorder:
    """Takes turns in the environment and keeps them; lists of per-turn tensors become a Rollout."""

    def __init__(self, env: SchedulingTorchRL, central: bool) -> None:
        self._env, self._central = env, central
        self._names = list(env.simulator.arrays)
        self._columns: dict[str, list[Tensor]] = {}
        self._views: tuple[list[dict[str, Tensor]], list[dict[str, Tensor]]] = ([], [])

    def observe(self, state: TensorDictBase, valid: np.ndarray, alive: np.ndarray) -> None:
        """Keep a state, in which the acting agents of `valid` rows are about to choose."""
        simulator = self._env.simulator
        self._views[0].append({name: state[name] for name in self._names})
        if self._central:
            self._views[1].append({name: torch.from_numpy(a) for name, a in simulator.observe_all().items()})
        self._keep(valid=torch.from_numpy(valid), alive=torch.from_numpy(alive))
        self._keep(times=torch.from_numpy(simulator.time.copy()), agents=torch.from_numpy(simulator.acting.copy()))

    def step(self, state: TensorDictBase, act: Act) -> tuple[TensorDictBase, Tensor]:
        """Take a turn; the next state and the actions chosen."""
        simulator = self._env.simulator
        actions, log_probs = act(self._views[0][-1], simulator.policy_noise(simulator.acting))
        after = self._env.step(state.set("action", actions))["next"]
        self._keep(actions=actions, log_probs=log_probs)
        self._keep(rewards=after["reward"].squeeze(-1), elapsed=after["elapsed"])
        return after, actions

    def _keep(self, **columns: Tensor) -> None:
        for name, column in columns.items():
            self._columns.setdefault(name, []).append(column)

    def rollout(self, length: int) -> Rollout:
        """Everything kept so far."""
        observation = _stacked(self._views[0])
        central = _stacked(self._views[1]) if self._central else observation
        columns = {name: torch.stack(kept) for name, kept in self._columns.items()}
        return Rollout(observation=observation, central=central, length=length, **columns)


def _stacked(views: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    return {name: torch.stack([view[name] for view in views]) for name in views[0]}


class EpisodeCollector:
    """Whole episodes: every call resets all rows.

    Args:
        env: whose horizon lies beyond every cut.
        central: record the full view beside the agents' own.
    """

    def __init__(self, env: SchedulingTorchRL, *, central: bool) -> None:
        self.env, self._central, self._resets = env, central, 0

    def collect(self, act: Act, length: int) -> Rollout:
        """Play every row until it ends or `length` has passed; what follows a cut counts for nothing."""
        state = self.env.reset()
        self._resets += 1
        recorder = _Recorder(self.env, self._central)
        while True:
            simulator = self.env.simulator
            playing = ~simulator.over & (simulator.time < length)
            recorder.observe(state, playing, playing)
            if not playing.any():
                return recorder.rollout(length)
            state, _ = recorder.step(state, act)

    def state(self) -> dict[str, np.ndarray]:
        """How often the rows were reset."""
        return {"resets": np.array([self._resets])}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Reset as often."""
        while self._resets < int(state["resets"][0]):
            self.env.reset()
            self._resets += 1


class SegmentCollector:
    """`turns` turns of every row in each call; rows play on from call to call.

    The first episodes of the rows are cut at different times, so that from then on every part of an episode
    is in every update.

    Args:
        env: whose horizon lies beyond every cut.
        turns: T of every rollout.
        length: of the first episodes.
        central: record the full view beside the agents' own.
    """

    def __init__(self, env: SchedulingTorchRL, *, turns: int, length: int, central: bool) -> None:
        rows = env.batch_size[0]
        self.env, self._turns, self._central = env, turns, central
        self._cut = np.maximum(length * np.arange(1, rows + 1) // rows, 1)
        self._resets = np.ones(rows, np.int64)
        self._taken = np.zeros(rows, np.int64)  # turns since a row's episode began
        self._chosen = np.zeros((rows, turns), np.int64)  # the actions chosen in them
        self._state = env.reset()

    def collect(self, act: Act, length: int) -> Rollout:
        """Play on; rows that begin a new episode are cut after `length`."""
        simulator = self.env.simulator
        recorder = _Recorder(self.env, self._central)
        for turn in range(self._turns + 1):
            alive = ~simulator.over
            valid = alive & (simulator.time < self._cut)
            recorder.observe(self._state, valid, alive)
            if turn < self._turns:
                self._state, actions = recorder.step(self._state, act)
                self._remember(actions.numpy())
                self._begin(~valid, length)
        return recorder.rollout(length)

    def _remember(self, actions: np.ndarray) -> None:
        if self._taken.max() == self._chosen.shape[1]:
            self._chosen = np.concatenate([self._chosen, np.zeros_like(self._chosen)], axis=1)
        self._chosen[np.arange(len(actions)), self._taken] = actions
        self._taken += 1

    def _begin(self, rows: np.ndarray, length: int) -> None:
        """New episodes in `rows`, bool (B,)."""
        if rows.any():
            self._cut[rows], self._taken[rows] = length, 0
            self._reset(rows)

    def _reset(self, rows: np.ndarray) -> None:
        self._resets[rows] += 1
        self._state = self.env.reset(self._state.set("_reset", torch.from_numpy(rows)[:, None]))

    def state(self) -> dict[str, np.ndarray]:
        """How often each row was reset, where its episode is cut, and what was chosen in it so far."""
        chosen = self._chosen[:, : max(int(self._taken.max()), 1)]
        return {
            "resets": self._resets.copy(),
            "cut": self._cut.copy(),
            "taken": self._taken.copy(),
            "chosen": chosen.copy(),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Replay the choices: a row with fewer of them starts later, so that all end together.

        Rows in their first episode have most choices and start at once: the constructor has reset them.
        """
        self._cut, self._taken, self._chosen = (np.array(state[name]) for name in ("cut", "taken", "chosen"))
        last, rows = state["resets"], np.arange(len(self._taken))
        while (self._resets < last - 1).any():
            self._reset(self._resets < last - 1)
        for left in range(int(self._taken.max()), -1, -1):
            starting = (self._taken == left) & (self._resets < last)
            if starting.any():
                self._reset(starting)
            if left > 0:
                replayed = self._taken - left  # negative before a row has started, whose turns do not matter
                actions = np.where(replayed >= 0, self._chosen[rows, np.maximum(replayed, 0)], 0)
                self._state = self.env.step(self._state.set("action", torch.from_numpy(actions)))["next"]

"""Sampling turns: whole batches of instances in lock-step, one forward pass for the acting agents of all rows.

Two ways to cut experience into updates. `EpisodeCollector` plays whole episodes from the start, all rows together;
rows that end early are masked. `SegmentCollector` plays a fixed number of turns in every row and goes on from there in
the next update, by one of TorchRL's collectors: `sync` in this process, `multi` in processes of this machine, `ray` in
actors of a Ray cluster. An environment cuts a row's episode at its length and begins a new instance; the state reached
is in `("next", ...)`, for the value of what would have followed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector as SyncCollector
from torchrl.collectors import MultiSyncCollector

from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.errors import InvalidOptionError, MarlSchedError
from marl_sched.train.actor import LOG_PROB, ActingLogits, actor
from marl_sched.train.device import device_of
from marl_sched.train.environment import TrainingEnv, TrainingTask

CollectorName = Literal["sync", "multi", "ray"]
_NO_LIMIT = 2**31 - 1  # turns of an episode


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """T turns of B rows.

    Attributes:
        data: batch (B, T), the environment's entries (marl_sched.train.environment) in the states in which turns were
            taken, with `action`, `action_log_prob` and, under `next`, what came of them.
        valid: bool (T, B), a turn that counts; what the others hold is meaningless.
        boundary: bool (T, B), no later turn of this rollout goes on from this one: the episode ended, was cut, or the
            rollout ends.
        terminated: bool (T, B), the episode ended, and there is no future to value.
        length: of the episodes, in the domain's unit.
        time_limit: simulated time at which an episode of that length is over; None: it follows from what happens.
        seconds: wall time that collecting took.
    """

    data: TensorDictBase
    valid: Tensor
    boundary: Tensor
    terminated: Tensor
    length: int
    time_limit: int | None
    seconds: float = 0.0

    def column(self, *name: str) -> Tensor:
        """An entry of one number per turn as (T, B)."""
        return self.data[name].flatten(2).squeeze(-1).T if self.data[name].dim() > 2 else self.data[name].T

    @property
    def turns(self) -> int:
        """T."""
        return int(self.data.shape[1])

    @property
    def actions(self) -> Tensor:
        """Int64 (T, B)."""
        return self.column("action")

    @property
    def log_probs(self) -> Tensor:
        """Float32 (T, B), of the actions under the policy that chose them."""
        return self.column(LOG_PROB)

    @property
    def rewards(self) -> Tensor:
        """Float64 (T, B), what the turns brought."""
        return self.column("next", "reward")

    @property
    def elapsed(self) -> Tensor:
        """Int64 (T, B), simulated time that the turns let pass."""
        return self.column("next", "elapsed")

    @property
    def times(self) -> Tensor:
        """Int64 (T, B), simulated time of the turns."""
        return self.column("time").long()

    @property
    def agents(self) -> Tensor:
        """Int64 (T, B), whose turn it was."""
        return self.column("acting")

    @property
    def horizon(self) -> int:
        """Simulated time at which the longest valid turn is over, or that at which episodes are cut, if it is known."""
        if self.time_limit is not None:
            return self.time_limit
        return int((self.times + self.elapsed)[self.valid].max())

    @property
    def reward_rate(self) -> float:
        """Reward per unit of simulated time over all valid turns: M1 of the sampling policy."""
        return float(self.rewards[self.valid].sum() / max(self.time, 1))

    @property
    def time(self) -> int:
        """Simulated time that passed in valid turns, over all rows."""
        return int(self.elapsed[self.valid].sum())

    @property
    def decisions(self) -> int:
        """Number of valid turns."""
        return int(self.valid.sum())


class Experience(Protocol):
    """What the training loop has to know of what was collected; the rest is between a collector and its learner."""

    @property
    def length(self) -> int:
        """Of the episodes, in the domain's unit."""

    @property
    def seconds(self) -> float:
        """Wall time that collecting took."""

    @property
    def reward_rate(self) -> float:
        """Reward per unit of simulated time."""

    @property
    def time(self) -> int:
        """Simulated time that passed."""

    @property
    def decisions(self) -> int:
        """How many decisions can be learned from."""


class Collector(Protocol):
    """What the training loop asks for.

    Attributes:
        name: as in the configuration.
    """

    name: str

    def collect(self, policy: PolicyNetwork, length: int) -> Experience:
        """Play with the policy's present parameters; episodes that begin now have that length."""

    def state(self) -> dict[str, np.ndarray]:
        """What a resumed run needs to go on."""

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a saved state; the collector must be new."""

    def close(self) -> None:
        """End workers."""


class EpisodeCollector:
    """Whole episodes: every call resets all rows, and plays in this process."""

    name = "sync"

    def __init__(self, task: TrainingTask) -> None:
        self.env, self._resets = task.environment(), 0

    def collect(self, policy: PolicyNetwork, length: int) -> Rollout:
        """Play every row until it ends or `length` has passed; what follows a cut counts for nothing."""
        started = time.perf_counter()
        module = ActingLogits(policy)
        module.prepare()
        self.env.episode_length = length
        self._resets += 1
        with torch.no_grad():
            data = self.env.rollout(_NO_LIMIT, actor(module), break_when_any_done=False, break_when_all_done=True)
        over = data["next", "done"].squeeze(-1).T
        valid = torch.cat([torch.ones_like(over[:1]), ~over[:-1]])
        terminated = data["next", "terminated"].squeeze(-1).T
        return Rollout(
            data=data,
            valid=valid,
            boundary=over,
            terminated=terminated,
            length=length,
            time_limit=_time_limit(self.env, length),
            seconds=time.perf_counter() - started,
        )

    def state(self) -> dict[str, np.ndarray]:
        """How often the rows were reset."""
        return {"resets": np.array([self._resets])}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Reset as often."""
        while self._resets < int(state["resets"][0]):
            self.env.reset()
            self._resets += 1

    def close(self) -> None:
        """There are no workers."""


class SegmentCollector:
    """`task.turns` turns of every row in each call, in this process; rows play on from call to call."""

    name: str = "sync"

    def __init__(self, task: TrainingTask) -> None:
        if task.turns is None:
            raise InvalidOptionError("collector: expected a task with a number of turns for each update, got None")
        self.task, self.env, self._turns = task, task.environment(), task.turns
        self._module: ActingLogits | None = None
        self._collector: Any = None
        self._batches: Iterator[TensorDictBase] = iter(())

    def collect(self, policy: PolicyNetwork, length: int) -> Rollout:
        """Play on; `length` is what the environment's curriculum gives to rows that begin in this update."""
        started = time.perf_counter()
        if self._module is None:
            self._module = ActingLogits(policy)
            self._collector = self._start(self._module)
            self._batches = iter(self._collector)
        elif self._module.network is not policy:
            raise InvalidOptionError("collect: expected the policy with which the collector began")
        self._synchronise(self._module)
        data = next(self._batches)
        if data.dim() == 3:  # Ray's workers side by side
            data = data.flatten(0, 1)
        done = data["next", "done"].squeeze(-1).T
        boundary = done.clone()
        boundary[-1] = True
        return Rollout(
            data=data,
            valid=torch.ones_like(done),
            boundary=boundary,
            terminated=data["next", "terminated"].squeeze(-1).T,
            length=length,
            time_limit=None,
            seconds=time.perf_counter() - started,
        )

    def _options(self) -> dict[str, Any]:
        """What all of TorchRL's collectors are told."""
        return {
            "frames_per_batch": self.task.rows * self._turns,
            "total_frames": -1,
        }

    def _start(self, module: ActingLogits) -> Any:
        device = device_of(module.network)
        return SyncCollector(
            self.env, actor(module), policy_device=device, env_device="cpu", storing_device="cpu",
            track_traj_ids=False, use_buffers=False, auto_register_policy_transforms=False,
            **self._options(),
        )  # fmt: skip

    def _synchronise(self, module: ActingLogits) -> None:
        """Let the collector act with the policy's present parameters, which here are its own."""
        module.prepare()

    def state(self) -> dict[str, np.ndarray]:
        """Where the environment stands."""
        return self.env.state_arrays()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on exactly as the collector that was saved."""
        self.env.load_arrays(state)

    def close(self) -> None:
        """Let TorchRL's collector go."""
        if self._collector is not None:
            self._collector.shutdown()
            self._collector = None


class WorkerCollector(SegmentCollector):
    """The same turns in several workers, each of which holds a part of the rows.

    With the same parameters the workers' rows play as those of `sync` do, as noise and choices are counter-based. A run
    that is resumed does not go on exactly: rows begin new episodes, none of which has been played before.

    Args:
        task: what is played.
        workers: number of workers, at most one per row.
    """

    def __init__(self, task: TrainingTask, workers: int) -> None:
        if task.rows % workers:
            raise InvalidOptionError(
                f"workers: expected a divisor of the {task.rows} rows that play at once (algorithm.instances), "
                f"got {workers}"
            )
        super().__init__(task)
        self._workers, self._updates, self._skip = workers, 0, 0

    def collect(self, policy: PolicyNetwork, length: int) -> Rollout:
        """See SegmentCollector."""
        self._updates += 1
        return super().collect(policy, length)

    def _factories(self) -> list[Any]:
        from dataclasses import replace

        task, rows = replace(self.task, skip=self._skip), self.task.rows // self._workers
        return [partial(task.environment, first, rows) for first in range(0, task.rows, rows)]

    def _synchronise(self, module: ActingLogits) -> None:
        self._collector.update_policy_weights_()

    def state(self) -> dict[str, np.ndarray]:
        """More episodes than any row can have begun: an episode has at least one turn."""
        return {"skip": np.array([self._skip + self._updates * self._turns])}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Begin with episodes that have not been played."""
        self._skip = int(state["skip"][0])


class MultiCollector(WorkerCollector):
    """Workers are processes of this machine."""

    name = "multi"

    def _start(self, module: ActingLogits) -> Any:
        return MultiSyncCollector(
            self._factories(), actor(module), cat_results=0, storing_device="cpu", **self._options()
        )


class RayCollector(WorkerCollector):
    """Workers are actors of a Ray cluster; needs the extra `cluster`."""

    name = "ray"

    def _start(self, module: ActingLogits) -> Any:
        try:
            from torchrl.collectors.distributed import RayCollector as TorchRLRay
        except ImportError as error:
            raise MarlSchedError(
                "collector=ray: expected ray to be installed: pip install 'marl-sched[cluster]'"
            ) from error
        options = {**self._options(), "total_frames": _NO_LIMIT**2}  # it takes -1 for none at all
        return TorchRLRay(self._factories(), actor(module), sync=True, **options)

    def _synchronise(self, module: ActingLogits) -> None:
        """Send the parameters, which workers begin with, from the second update on.

        By then workers have started, which takes longer than the connection waits.
        """
        if self._updates > 1:
            super()._synchronise(module)


def segment_collector(task: TrainingTask, name: CollectorName, workers: int) -> SegmentCollector:
    """The collector of that name."""
    if name == "sync":
        return SegmentCollector(task)
    return (MultiCollector if name == "multi" else RayCollector)(task, workers)


def _time_limit(env: TrainingEnv, length: int) -> int | None:
    """When an episode of that length is over, where the domain counts its length in simulated time."""
    return length if env.simulator.unit == env.simulator.time_unit else None

"""Schedulers that remember: what an agent carries from one of its decisions to the next.

An agent's memory is a row of float32 numbers. It is `initial_memory` at the start of an episode, goes into every one of
the agent's decisions and comes out of it changed, and no other agent reads it. In a simulator the scheduler keeps the
memories of all agents; an agent that runs by itself keeps its own (`LocalAgent`), and begins with the initial one
when it is started again.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from marl_sched.agents.base import ObservationScheduler, Scheduler, batched
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]


class RecurrentScheduler(Scheduler):
    """Decides from an agent's observation, its memory and one uniform.

    Attributes:
        memory_size: numbers that an agent remembers.
    """

    memory_size: int
    _memories: np.ndarray | None = None  # float32 (B, max_agents, memory_size)

    def initial_memory(self, batch: int) -> np.ndarray:
        """The memories of `batch` agents before their first decisions, float32 (batch, memory_size)."""
        return np.zeros((batch, self.memory_size), np.float32)

    @abstractmethod
    def choose_recurrent(
        self, observation: Observation, memory: np.ndarray, uniform: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions int64 (B,) and new memories float32 (B, memory_size).

        From batched observations, memories float32 (B, memory_size) and uniforms float64 (B,) in [0, 1).
        """

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Give the agents of `envs`, bool (B,), their initial memories."""
        shape = (simulator.batch, simulator.max_agents, self.memory_size)
        if self._memories is None or self._memories.shape != shape:
            self._memories = np.zeros(shape, np.float32)
        initial = self.initial_memory(int(envs.sum()) * simulator.max_agents)
        self._memories[envs] = initial.reshape(-1, simulator.max_agents, self.memory_size)

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Observe for every acting agent under the simulator's view, choose, and keep what it remembers."""
        if self._memories is None:
            raise InvalidOptionError(f"{self.name}: expected start(simulator, envs) before the first decision")
        rows, observation = simulator.observe_acting()
        actions = np.zeros(simulator.batch, np.int64)
        if len(rows):
            agents = simulator.acting[rows]
            uniform = simulator.policy_noise(simulator.acting)[rows]
            actions[rows], memory = self.choose_recurrent(observation, self._memories[rows, agents], uniform)
            self._memories[rows, agents] = memory
        return actions


class LocalAgent:
    """One agent that decides by itself; equal, bit for bit, to that agent in a simulator of one environment.

    Args:
        scheduler: what it decides by, with a memory or without.

    Attributes:
        memory: float32 (1, memory_size); None without one.
        remembered: how many decisions the memory holds; None without one.
    """

    def __init__(self, scheduler: ObservationScheduler | RecurrentScheduler) -> None:
        self._scheduler = scheduler
        self.memory: np.ndarray | None = None
        self.remembered: int | None = None
        self.reset()

    def reset(self) -> None:
        """Forget everything, as at the start of an episode."""
        if isinstance(self._scheduler, RecurrentScheduler):
            self.memory, self.remembered = self._scheduler.initial_memory(1), 0

    def choose(self, observation: Observation, uniform: float = 0.0) -> int:
        """The agent's choice from its observation with B = 1, and a uniform in [0, 1) for one that samples."""
        noise = np.array([uniform])
        if isinstance(self._scheduler, ObservationScheduler):
            return int(self._scheduler.choose(observation, noise)[0])
        actions, self.memory = self._scheduler.choose_recurrent(observation, self._remembering(), noise)
        self.remembered = (self.remembered or 0) + 1
        return int(actions[0])

    def act(self, observation: Observation, uniform: float = 0.0) -> int:
        """The agent's choice from its own observation without batch axis, as PettingZoo gives it."""
        return self.choose(batched(observation), uniform)

    def _remembering(self) -> np.ndarray:
        if self.memory is None:
            raise RuntimeError("an agent of a RecurrentScheduler has a memory")
        return self.memory

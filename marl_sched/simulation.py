"""What every domain's simulator offers: a batch of instances, each a process in which agents take turns.

At each decision epoch every unfinished row has one acting agent. Action 0 always means "do nothing" and is always
legal. Agents that are free at the same simulated decision epoch act in turn, each seeing what its view lets it see
of the earlier choices; when none is left, simulated time passes until an agent is free again.
Rows never influence each other. All arrays lead with the batch axis B.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from marl_sched.errors import IllegalActionError
from marl_sched.graph import ACTION_MASK, ArraySpec, GraphSpec
from marl_sched.noise import Stream, uniforms

Observation = dict[str, np.ndarray]


class TurnSimulator(ABC):
    """A batch of instances in which agents take turns; see the module's page.

    Attributes (all shapes with B = `batch`):
        batch: number of rows.
        view: what acting agents see, an instance of one of the domain's views; its `kind` is the view's name.
        max_agents, max_actions: padded sizes; actions are 0..max_actions-1.
        n_agents: int64 (B,), agents of each row's instance.
        acting: int64 (B,), the agent to act, -1 where nobody is to act because the episode is over.
        time: int64 (B,), simulated time (AirME: hours, MuRSE: time units).
        reward: float64 (B,), team reward of the time the last step let pass; 0 while others act at the decision epoch.
        elapsed: int64 (B,), simulated time that the last step let pass.
        conflict: bool (B,), the last choice was legal in the agent's view and impossible in truth.
        terminated, truncated: bool (B,), how the episode ended, false while it runs.
        episode_keys: uint64 (B,), counter-based randomness of the running episodes (marl_sched.noise).
        graph: the metagraph of the observations.
        arrays: name -> ArraySpec of the observation's arrays.
    """

    batch: int
    view: Any
    max_agents: int
    max_actions: int
    n_agents: np.ndarray
    acting: np.ndarray
    time: np.ndarray
    reward: np.ndarray
    elapsed: np.ndarray
    conflict: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    episode_keys: np.ndarray
    graph: GraphSpec
    arrays: Mapping[str, ArraySpec]

    @abstractmethod
    def reset(
        self,
        rows: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[Any] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start a new episode in `rows` (bool (B,), all if None).

        With a seed the rows start episode 0 of that seed, without one the next episode of theirs; `episodes`,
        one number for each chosen row in order, says otherwise (rows that share an instance need it).
        `instances`, likewise, replace the rows' instances.
        """

    @abstractmethod
    def step(self, actions: np.ndarray) -> None:
        """Apply the acting agents' choices, int64 (B,), and go on to each row's next acting agent.

        Rows that are over ignore their action. An action that is impossible in truth idles the agent and
        sets `conflict`; whether it is legal in the agent's view is for the environment APIs to check.
        Raises IllegalActionError for an action outside [0, max_actions).
        """

    @abstractmethod
    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """The graph that each row's agent, int64 (B,), sees now, written to `out` or to fresh arrays.

        A negative agent gives an empty graph in which only action 0 is legal. An agent that is busy or has
        acted at this decision epoch may do nothing but action 0.
        """

    @abstractmethod
    def observe_all(self) -> Observation:
        """The graph under the full view with row's acting agent: the centralised information pattern."""

    @abstractmethod
    def free_agents(self, row: int) -> np.ndarray:
        """The agents, int64, that have still to act at this decision epoch in `row`, in turn order."""

    def give_turn(self, row: int, agent: int) -> None:
        """Let an agent that has still to act at this decision epoch act next; the others follow in turn order.

        Raises IllegalActionError for an agent that has no turn left.
        """
        if agent not in self.free_agents(row):
            raise IllegalActionError(f"row {row}: agent {agent} has no turn at time {self.time[row]}")
        self.acting[row] = agent

    @abstractmethod
    def objectives(self) -> dict[str, np.ndarray]:
        """The domain's measures of the running or finished episodes, name -> float64 (B,)."""

    def per_round(self) -> dict[str, np.ndarray]:
        """Measures of each round of an episode, name -> float64 (B, rounds), NaN where there is nothing to measure.

        Empty for domains whose episodes have no rounds.
        """
        return {}

    @abstractmethod
    def snapshot(self, row: int) -> dict[str, np.ndarray]:
        """Copies of all arrays of one row's true state, for traces, rendering and bit-equality tests."""

    def new_observation(self) -> Observation:
        """Zeroed arrays of an observation for this batch, to pass as `out`."""
        return {name: spec.empty(self.batch) for name, spec in self.arrays.items()}

    def legal(self) -> np.ndarray:
        """The acting agents' action masks, int8 (B, max_actions)."""
        return self.observe(self.acting)[ACTION_MASK]

    def policy_noise(self, agents: np.ndarray, draw: int = 0) -> np.ndarray:
        """The uniform, float64 (B,), with which a sampling policy picks for these agents at this decision epoch."""
        return uniforms(self.episode_keys, self.time, Stream.POLICY, np.maximum(agents, 0), draw)

    @property
    def over(self) -> np.ndarray:
        """Bool (B,), rows whose episode has ended."""
        return self.terminated | self.truncated

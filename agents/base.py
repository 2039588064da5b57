"""What decides: one protocol for rules, solvers and learned policies.

A `Scheduler` takes the turn of the acting agent in every row of a simulator. One that needs no more than
what the agent sees is an `ObservationScheduler`: the same object then works centralised (a full view), as
one agent among others (a local view), in PettingZoo, and in an agent process that never meets a simulator.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.privileged import PrivilegedInfo

if TYPE_CHECKING:
    from marl_sched.simulation import TurnSimulator


class EpochPlayer(Protocol):
    """Plays whole decision epochs in one compiled call; the choices are those that turns would make."""

    def __call__(self, count: int) -> tuple[float, int]:
        """Play up to `count` decision epochs in every row that is not over.

        Returns the sum over all decisions of the visible share of the deciding agent's graph, and their number.
        """


@dataclass(frozen=True)
class Worths:
    """What the acting agents' actions are worth to a scheduler: float64 (B, n_actions), not finite where it takes none.

    Attributes:
        meaning: what the values are, in words.
        better: whether higher or lower values are.
        first: bool (B, n_actions), actions that go before all others whatever their value; None: there are none such.
    """

    values: np.ndarray
    meaning: str
    better: Literal["higher", "lower"] = "higher"
    first: np.ndarray | None = None


class Scheduler(ABC):
    """Chooses actions for acting agents.

    Attributes:
        name: as users type it.
        privileged_info: what it uses beyond the acting agent's observation; printed with every result.
        simulator_options: options of the simulator that belong to it, where a user does not choose others.
        plans_on_estimates: whether it decides from nothing but what the team counts on and has committed to, so that an
            agent that is told that can run it (LocalState.simulator). An ObservationScheduler needs no more anyway.
        heeds_objective: whether its choices may depend on the simulator's objective; if not, one episode gives its
            scores for every objective.
    """

    name: str
    privileged_info: PrivilegedInfo = PrivilegedInfo.NONE
    simulator_options: Mapping[str, Any] = MappingProxyType({})
    plans_on_estimates: bool = False
    heeds_objective: bool = True

    def __repr__(self) -> str:
        """One line: the class, the name, and what it knows besides."""
        known = f", knows {self.privileged_info}" if self.privileged_info else ""
        return f"{type(self).__name__}({self.name}{known})"

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Called after `envs`, bool (B,), began a new episode; planners make their plans here."""

    def per_round(self) -> dict[str, np.ndarray]:
        """What the scheduler counted of itself, such as messages: name -> float64 (B, rounds); mostly nothing."""
        return {}

    @abstractmethod
    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,) for the acting agents; rows that are over get 0."""

    def worths(self, simulator: TurnSimulator) -> Worths | None:
        """What it thinks of the acting agents' actions, for people; None for a scheduler that cannot tell."""
        return None

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer | None:
        """What plays this scheduler's decision epochs on a simulator, which it is started on, in compiled code.

        None where a scheduler has none: then it takes turns. Either way the simulator goes through the same states.
        """
        return None


class ObservationScheduler(Scheduler):
    """A scheduler that needs only the acting agent's observation and, to sample, one uniform.

    Attributes:
        samples: whether it chooses by chance, so that its choice depends on the uniform.
    """

    samples: bool = False

    @abstractmethod
    def choose(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,) from batched observations and uniforms float64 (B,) in [0, 1)."""

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Observe for every acting agent under the simulator's view, then choose."""
        rows, observation = simulator.observe_acting()
        noise = simulator.policy_noise(simulator.acting)[rows] if self.samples else np.zeros(len(rows))
        actions = np.zeros(simulator.batch, np.int64)
        if len(rows):
            actions[rows] = self.choose(observation, noise)
        return actions

    def act(self, observation: Mapping[str, np.ndarray], uniform: float | None = None) -> int:
        """One agent's choice from its own observation without batch axis, as PettingZoo gives it.

        Accepts the environment API's `{"observation": ..., "action_mask": ...}` or the flat dict. `uniform` in [0, 1)
        picks by inverse distribution, so a scheduler that samples must be given one, drawn by the caller; others
        ignore it. Raises InvalidOptionError where it is missing.
        """
        if uniform is None and self.samples:
            raise InvalidOptionError(f"{self.name} samples: act(observation, uniform): expected a number in [0, 1)")
        return int(self.choose(batched(observation), np.array([uniform or 0.0]))[0])


class AdvantageScheduler(ObservationScheduler):
    """A scheduler that can tell how good every choice is, so that a policy can learn from it by imitation."""

    @abstractmethod
    def advantages(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """What each action is worth more than doing nothing, float64 (B, n_actions).

        0 for action 0, -inf for actions that are not legal or not worth considering.
        """

    def worths(self, simulator: TurnSimulator) -> Worths:
        """Its advantages."""
        found = self.advantages(simulator.observe(simulator.acting))
        return Worths(found, f"gain over doing nothing, by {self.name}")


class CostScheduler(Scheduler):
    """A scheduler that works out what every choice would cost the team, so that a policy can learn from it."""

    @abstractmethod
    def costs(self, simulator: TurnSimulator, legal: np.ndarray) -> np.ndarray:
        """What the acting agents' choices cost, float64 (B, n_actions); inf for those that are not to be made.

        `legal` int8 (B, n_actions) are the acting agents' action masks under the simulator's view. Rows that are
        over hold anything.
        """

    def worths(self, simulator: TurnSimulator) -> Worths:
        """Its costs."""
        return Worths(self.costs(simulator, simulator.legal()), f"cost of what follows, by {self.name}", "lower")


def batched(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """One agent's observation, flat or as PettingZoo gives it, as arrays with B = 1."""
    flat: dict[str, np.ndarray] = dict(observation.get("observation", observation))
    if ACTION_MASK not in flat:
        flat[ACTION_MASK] = observation[ACTION_MASK]
    return {name: np.asarray(value)[None] for name, value in flat.items()}


def best_action(score: np.ndarray, eligible: np.ndarray) -> np.ndarray:
    """The eligible action with the highest score, ties to the lowest index, 0 where none is eligible.

    score float64 (B, n_actions), eligible bool (B, n_actions); returns int64 (B,).
    """
    masked = np.where(eligible, score, -np.inf)
    best = masked.argmax(axis=1)
    return np.where(eligible.any(axis=1), best, 0).astype(np.int64)


def inverse_distribution(logits: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """For each row the first action whose cumulated probability exceeds the row's uniform.

    logits (B, n_actions), with at least one that is not the lowest finite number; uniform float64 (B,) in
    [0, 1); returns int64 (B,). Actions of probability zero are never picked.
    """
    weights = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
    cumulated = weights.cumsum(axis=1)
    # A uniform next to 1 may round up to the total; the largest number below the total still has an action.
    level = np.minimum(uniform * cumulated[:, -1], np.nextafter(cumulated[:, -1], 0.0))
    return (cumulated > level[:, None]).argmax(axis=1)

"""Networks that plan whole rounds, outside of the simulator's turns: what they are to everything that trains or plays.

Such a network reads a metagraph of its own, which a domain's turns do not show, such as that of a schedule under
construction. It says itself what plays it: a `TrainedPlanner`, a scheduler like any other. Its weights and card
are those of every policy, and so are the commands that train, export, list and evaluate it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator

if TYPE_CHECKING:
    from marl_sched.agents.policies.cards import PolicyCard


class TrainedPlanner(Scheduler):
    """A scheduler that plans by a network.

    Attributes:
        card: what the weights are, if they come from a file.
    """

    card: PolicyCard | None = None

    def best_of(self, samples: int) -> Scheduler:
        """What follows the best of so many of its plans; InvalidOptionError for one that has a single plan."""
        raise InvalidOptionError(f"scheduler {self.name}: samples: it makes one plan")


class PlannerNetwork(PolicyNetwork):
    """A network of which a `TrainedPlanner` makes whole schedules.

    The struct of its sizes names its own metagraph (`NetworkConfig.metagraph`).
    """

    @abstractmethod
    def planner(self, name: str, card: PolicyCard | None, **options: Any) -> TrainedPlanner:
        """What plays a copy of the network; TypeError or InvalidOptionError for options that it does not have."""


class StepwiseNetwork(PlannerNetwork):
    """A planner's network that decides one step of a schedule after the other, and so can learn from an expert's.

    `forward` gives the worths of the actions at a batch of steps, float (K, n_actions); the largest one is taken.
    """

    @abstractmethod
    def demonstration(self, simulator: TurnSimulator, row: int) -> np.ndarray:
        """The schedule that a simulator's row has just played, int64 (3, N), as `steps` reads it; N = 0: a bad one."""

    @abstractmethod
    def steps(self, instance: Any, schedule: np.ndarray, discount: float) -> Mapping[str, np.ndarray]:
        """The steps of a schedule of an instance in which there was a choice.

        Arrays of the network's observation with a leading axis K, `label` int64 (K,), the action that the schedule
        takes, and `return` float64 (K,), what the steps from there on bring, discounted for each.
        """

    @abstractmethod
    def gathered(self, steps: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Steps of several instances as one batch, padded to the largest."""

    @abstractmethod
    def explored(self, instances: Sequence[Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
        """The steps with a choice that the network comes to when it plans instances itself, by sampling.

        Arrays of its observation with a leading axis K, and `costs` float64 (K, n_actions), what a schedule costs that
        a rule of the domain completes after each action; inf for actions that are not offered.
        """

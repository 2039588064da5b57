"""Rules for AirME (dissertation, section 6.5.1): what a crew does with what it sees.

A crew serves the best plane that it sees and that nobody has in hand. Under the full view, with crews acting
in turn, that is the same as handing the free crews the head of a priority queue, which is how the
dissertation puts it. Rules may recall flying planes. How planes are ranked stands in
marl_sched.agents.airme.ranking.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import cast

import numpy as np

from marl_sched.agents.airme import ranking, thresholds
from marl_sched.agents.airme.bound.index import require_types
from marl_sched.agents.airme.epochs import EpochPlayer
from marl_sched.agents.airme.ranking import N_FEATURES, Ranking
from marl_sched.agents.base import ObservationScheduler, Worths, best_action
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType, FailureModel, failure_table
from marl_sched.envs.airme.features import PLANE
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.errors import InvalidOptionError
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]
_NO_FAILURES = np.zeros((1, 1, 1))


class PriorityRule(ObservationScheduler):
    """Serve the open plane of the highest rank."""

    heeds_objective = False

    def __init__(self, name: str, ranking: Ranking, privileged_info: PrivilegedInfo = PrivilegedInfo.NONE) -> None:
        self.name, self.privileged_info, self.ranking = name, privileged_info, ranking

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,); `uniform` is not used."""
        failure = self._failures(observation["plane"])
        ranks = ranking.rank_observation(observation, failure, self.ranking)
        return best_action(ranks, ranks > self.ranking.least)

    def worths(self, simulator: TurnSimulator) -> Worths:
        """Its ranks; broken planes, or worn ones, that go before all others are marked."""
        observation = simulator.observe(simulator.acting)
        ranks = ranking.rank_observation(observation, self._failures(observation["plane"]), self.ranking)
        ranks = np.where(ranks > self.ranking.least, ranks, -np.inf)
        first = ranks >= thresholds.FIRST
        return Worths(np.where(first, ranks - thresholds.FIRST, ranks), f"what {self.name} ranks by", first=first)

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer:
        """What plays this rule's decision epochs in one call."""
        return EpochPlayer(cast(AirmeSimulator, simulator), self.ranking)

    def _failures(self, plane: np.ndarray) -> np.ndarray:
        """Failure probabilities float64 (n_types, n_parts, longest + 1) that cover an observation's planes."""
        return _NO_FAILURES


class PeriodicRule(PriorityRule):
    """Acts only in hours that are multiples of the period; then serves broken planes, then all others by hours."""

    def __init__(self, period: int = thresholds.PERIOD) -> None:
        if period < 1:
            raise InvalidOptionError(f"periodic: period: expected at least 1 hour, got {period}")
        super().__init__("periodic", ranking.ranking(ranking.PERIODIC, period=period))


def corrective() -> PriorityRule:
    """Broken planes by hourly income."""
    return PriorityRule("corrective", ranking.ranking(ranking.CORRECTIVE))


def corrective_as_published() -> PriorityRule:
    """Broken planes in plane order, as the published code runs it."""
    return PriorityRule("corrective-published", ranking.ranking(ranking.CORRECTIVE_AS_PUBLISHED))


def condition(threshold: float = thresholds.HOURS) -> PriorityRule:
    """Broken planes by income, then unbroken ones with at least `threshold` operating hours, by hours."""
    return PriorityRule("condition", ranking.ranking(ranking.CONDITION, hours=threshold))


class ModelBasedRule(PriorityRule):
    """Broken planes by income, then unbroken ones by their true failure probability of an hour flown now.

    Args:
        threshold: the least failure probability that is served.
        types, failure: the failure model until it is started on a simulator, whose own takes its place.

    An observation of another number of types raises InvalidOptionError.
    """

    def __init__(
        self,
        threshold: float = thresholds.FAILURE,
        types: Sequence[AircraftType] = PUBLISHED_TYPES,
        failure: FailureModel = "density",
    ) -> None:
        super().__init__(
            "model-based",
            ranking.ranking(ranking.MODEL_BASED, risk=threshold),
            privileged_info=PrivilegedInfo.FAILURE_MODEL,
        )
        self._types, self._failure = tuple(types), failure

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Know the simulator's types and failure model."""
        of = cast(AirmeSimulator, simulator)
        self._types, self._failure = of.types, of.failure

    def _failures(self, plane: np.ndarray) -> np.ndarray:
        require_types(self.name, plane.shape[-1] - N_FEATURES, self._types)
        longest = int(max(PLANE.read(plane, "hours").max(), PLANE.read(plane, "landings").max())) + 1
        return _failure_table(self._types, self._failure, longest.bit_length())


@lru_cache(maxsize=16)
def _failure_table(types: tuple[AircraftType, ...], failure: FailureModel, bits: int) -> np.ndarray:
    return failure_table(types, (1 << bits) - 1, failure)


def preventive_first(
    hours: float = thresholds.PREVENTIVE_HOURS, landings: float = thresholds.PREVENTIVE_LANDINGS
) -> PriorityRule:
    """Worn planes before broken ones: it keeps the backlog of long repairs from eating the crews.

    Fixed-wing planes (type 0) from `hours` operating hours and all others from `landings` landings on come first, by
    hours x income; broken planes follow, by income. Not in the dissertation.
    """
    return PriorityRule("preventive-first", ranking.ranking(ranking.PREVENTIVE_FIRST, hours=hours, landings=landings))

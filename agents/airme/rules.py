"""Rules for AirME (dissertation, section 6.5.1), each a function of one crew's observation.

A crew serves the best plane that it sees and that nobody has in hand. Under the full view, with crews acting
in turn, that is the same as handing the free crews the head of a priority queue, which is how the
dissertation puts it. Rules may recall flying planes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import cast

import numpy as np

from marl_sched.agents.airme.bound.index import require_types
from marl_sched.agents.base import ObservationScheduler, PrivilegedInfo, best_action
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType, FailureModel, failure_table
from marl_sched.envs.airme.graph import graph_spec
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]
_FIRST = 1e9  # added to scores of planes that go before all others
_PERIOD = 6  # hours, periodic
_HOURS_THRESHOLD = 40.0  # condition-based
_FAILURE_THRESHOLD = 0.004  # model-based
_PREVENTIVE_HOURS, _PREVENTIVE_LANDINGS = 45.0, 4.0


def _column(name: str) -> int:
    return graph_spec(0).node("plane").features.index(name)


_HOURS, _LANDINGS, _INCOME = _column("hours/10"), _column("landings/5"), _column("income/10")
_BROKEN, _FIRST_TYPE = _column("broken"), len(graph_spec(0).node("plane").features)


class _Fleet:
    """The planes of an observation in their own units: every field (B, P + 1)."""

    def __init__(self, observation: Observation) -> None:
        plane = np.asarray(observation["plane"], np.float64)
        self.hours = np.rint(plane[..., _HOURS] * 10)
        self.landings = np.rint(plane[..., _LANDINGS] * 5)
        self.income = plane[..., _INCOME] * 10
        self.broken = plane[..., _BROKEN] > 0
        self.types = plane[..., _FIRST_TYPE:]  # (B, P + 1, n_types), one-hot
        self.open = np.asarray(observation["action_mask"]) > 0
        self.open[:, 0] = False  # the null plane is what remains


class PriorityRule(ObservationScheduler):
    """Serve the open plane of the highest priority; `priority` gives -inf to planes that are not to be served."""

    heeds_objective = False

    def __init__(
        self, name: str, priority: Callable[[_Fleet], np.ndarray], privileged_info: PrivilegedInfo = PrivilegedInfo.NONE
    ) -> None:
        self.name, self.privileged_info, self._priority = name, privileged_info, priority

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,); `uniform` is not used."""
        fleet = _Fleet(observation)
        priority = self._priority(fleet)
        return best_action(priority, fleet.open & (priority > -np.inf))


class RandomRule(ObservationScheduler):
    """Any plane that may be chosen or the null plane, all alike."""

    name = "random"
    heeds_objective = False
    samples = True

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,) by inverse distribution from `uniform` float64 (B,)."""
        legal = np.asarray(observation["action_mask"]) > 0
        rank = np.floor(uniform * legal.sum(axis=1)).astype(np.int64)
        return (legal.cumsum(axis=1) > rank[:, None]).argmax(axis=1).astype(np.int64)


class PeriodicRule(PriorityRule):
    """Acts only in hours that are multiples of the period; then serves broken planes, then all others by hours."""

    def __init__(self, period: int = _PERIOD) -> None:
        if period < 1:
            raise InvalidOptionError(f"periodic: period: expected at least 1 hour, got {period}")
        super().__init__("periodic", lambda fleet: np.where(fleet.broken, _FIRST + fleet.income, fleet.hours))
        self._period = period

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,), 0 between periods."""
        due = np.asarray(observation["time"]) % self._period == 0
        return np.where(due, super().choose(observation, uniform), 0)


def corrective() -> PriorityRule:
    """Broken planes by hourly income."""
    return PriorityRule("corrective", lambda fleet: np.where(fleet.broken, fleet.income, -np.inf))


def corrective_as_published() -> PriorityRule:
    """Broken planes in plane order, as the published code runs it."""
    return PriorityRule("corrective-published", lambda fleet: np.where(fleet.broken, 0.0, -np.inf))


def condition(threshold: float = _HOURS_THRESHOLD) -> PriorityRule:
    """Broken planes by income, then unbroken ones with at least `threshold` operating hours, by hours."""

    def priority(fleet: _Fleet) -> np.ndarray:
        worn = np.where(fleet.hours >= threshold, fleet.hours, -np.inf)
        return np.where(fleet.broken, _FIRST + fleet.income, worn)

    return PriorityRule("condition", priority)


class ModelBasedRule(PriorityRule):
    """Broken planes by income, then unbroken ones by their true failure probability of an hour flown now.

    Args:
        threshold: the least failure probability that is served.
        types, failure: the failure model until it is started on a simulator, whose own takes its place.

    An observation of another number of types raises InvalidOptionError.
    """

    def __init__(
        self,
        threshold: float = _FAILURE_THRESHOLD,
        types: Sequence[AircraftType] = PUBLISHED_TYPES,
        failure: FailureModel = "density",
    ) -> None:
        super().__init__("model-based", self._by_risk, privileged_info=PrivilegedInfo.FAILURE_MODEL)
        self._threshold, self._types, self._failure = threshold, tuple(types), failure

    def start(self, simulator: TurnSimulator, rows: np.ndarray) -> None:
        """Know the simulator's types and failure model."""
        of = cast(AirmeSimulator, simulator)
        self._types, self._failure = of.types, of.failure

    def _by_risk(self, fleet: _Fleet) -> np.ndarray:
        require_types(self.name, fleet.types.shape[-1], self._types)
        kind = (fleet.types @ np.arange(len(self._types))).astype(np.int64)
        hours, landings = fleet.hours.astype(np.int64), fleet.landings.astype(np.int64)
        table = _failure_table(self._types, self._failure, int(max(hours.max(), landings.max())).bit_length())
        survival = np.ones_like(fleet.hours)
        for part in range(table.shape[1]):
            survival *= 1.0 - table[kind, part, landings if part == 0 else hours]
        risk = 1.0 - survival
        return np.where(fleet.broken, _FIRST + fleet.income, np.where(risk >= self._threshold, risk, -np.inf))


@lru_cache(maxsize=16)
def _failure_table(types: tuple[AircraftType, ...], failure: FailureModel, bits: int) -> np.ndarray:
    return failure_table(types, (1 << bits) - 1, failure)


def preventive_first(hours: float = _PREVENTIVE_HOURS, landings: float = _PREVENTIVE_LANDINGS) -> PriorityRule:
    """Worn planes before broken ones: it keeps the backlog of long repairs from eating the crews.

    Fixed-wing planes (type 0) from `hours` operating hours and helicopters (type 1) from `landings` landings on
    come first, by hours x income; broken planes follow, by income. Not in the dissertation.
    """

    def priority(fleet: _Fleet) -> np.ndarray:
        fixed_wing = fleet.types[..., 0] > 0
        worn = np.where(fixed_wing, fleet.hours >= hours, fleet.landings >= landings)
        preventive = np.where(worn, _FIRST + fleet.hours * fleet.income, -np.inf)
        return np.where(fleet.broken, fleet.income, preventive)

    return PriorityRule("preventive-first", priority)

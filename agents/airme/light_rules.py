"""The rules of AirME that a light agent can decide by: those of marl_sched.agents.airme.rules, ranked in NumPy.

A plane is ranked as the kernel `marl_sched.agents.airme.ranking.rank` does, with the same ties. `model-based` and the
index are not among them: they hold tables of the failure model, which compiled code makes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from marl_sched.agents.airme.thresholds import FIRST, HOURS, PERIOD, PREVENTIVE_HOURS, PREVENTIVE_LANDINGS
from marl_sched.agents.base import ObservationScheduler, best_action
from marl_sched.envs.airme.features import PLANE

Observation = Mapping[str, np.ndarray]
Rank = Callable[[Mapping[str, np.ndarray]], np.ndarray]
_NO = -np.inf


class LightPriorityRule(ObservationScheduler):
    """Serve the open plane of the highest rank.

    Args:
        name: that of the compiled rule.
        rank: quantities of planes, float64 (B, P + 1) each, in their own units -> ranks (B, P + 1), -inf for never.
        period: hours; nothing is served between multiples of it.
    """

    heeds_objective = False

    def __init__(self, name: str, rank: Rank, period: int = 1) -> None:
        self.name, self._rank, self._period = name, rank, period

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,); `uniform` is not used."""
        plane, legal = observation["plane"], np.asarray(observation["action_mask"]) > 0
        quantities = {name: PLANE.read(plane, name) for name in ("hours", "landings", "income")}
        quantities["broken"] = plane[..., PLANE.index("broken")] > 0
        quantities["kind"] = plane[..., len(PLANE) :].argmax(-1)
        ranks = self._rank(quantities)
        due = np.asarray(observation["time"])[:, None] % self._period == 0
        return best_action(ranks, legal & due & (ranks > _NO) & (np.arange(ranks.shape[1]) > 0))


class RandomRule(ObservationScheduler):
    """Any plane that may be chosen or the null plane, all alike."""

    name = "random"
    heeds_objective = False
    samples = True

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,) by inverse distribution from `uniform` float64 (B,)."""
        legal = np.asarray(observation["action_mask"]) > 0
        rank = np.floor(uniform * legal.sum(axis=1)).astype(np.int64)
        return np.asarray((legal.cumsum(axis=1) > rank[:, None]).argmax(axis=1), np.int64)


def _corrective(of: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.where(of["broken"], of["income"], _NO)


def _corrective_as_published(of: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.where(of["broken"], 0.0, _NO)


def _condition(of: Mapping[str, np.ndarray]) -> np.ndarray:
    worn = np.where(of["hours"] >= HOURS, of["hours"], _NO)
    return np.where(of["broken"], FIRST + of["income"], worn)


def _periodic(of: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.where(of["broken"], FIRST + of["income"], of["hours"])


def _preventive_first(of: Mapping[str, np.ndarray]) -> np.ndarray:
    fixed_wing = of["kind"] == 0
    worn = np.where(fixed_wing, of["hours"] >= PREVENTIVE_HOURS, of["landings"] >= PREVENTIVE_LANDINGS)
    return np.where(of["broken"], of["income"], np.where(worn, FIRST + of["hours"] * of["income"], _NO))


RULES: dict[str, Callable[[], ObservationScheduler]] = {
    "random": RandomRule,
    "corrective": lambda: LightPriorityRule("corrective", _corrective),
    "corrective-published": lambda: LightPriorityRule("corrective-published", _corrective_as_published),
    "condition": lambda: LightPriorityRule("condition", _condition),
    "periodic": lambda: LightPriorityRule("periodic", _periodic, PERIOD),
    "preventive-first": lambda: LightPriorityRule("preventive-first", _preventive_first),
}

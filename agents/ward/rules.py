"""Rules for the delivery ward: whom a nurse takes over next, from what she sees.

The simple rules keep a nurse within her capacity: they take over a patient only if the nurse can attend to her beside
those whom she has. `MarginalCost` weighs what a takeover saves against what it makes her own patients miss.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from marl_sched.agents.base import ObservationScheduler, best_action
from marl_sched.envs.ward.dynamics import ADMISSION, BIRTH, CAPACITY, HANDOVER, LOAD, MEAN_QUARTERS, RECOVERY
from marl_sched.envs.ward.features import PATIENT, STATE
from marl_sched.envs.ward.instance import STAGES
from marl_sched.envs.ward.lookahead import expected_rates, savings_of
from marl_sched.errors import require_integer

Observation = Mapping[str, np.ndarray]
MOST_QUARTERS = 1000
_NEVER = 1e6  # quarters: slack of a patient whose labour is over


class RandomRule(ObservationScheduler):
    """Any patient who may be taken over, or nobody, all alike."""

    name = "random"
    heeds_objective = False
    samples = True

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,) by inverse distribution from `uniform` float64 (B,)."""
        legal = np.asarray(observation["action_mask"]) > 0
        rank = np.floor(uniform * legal.sum(axis=1)).astype(np.int64)
        return (legal.cumsum(axis=1) > rank[:, None]).argmax(axis=1).astype(np.int64)


class PriorityRule(ObservationScheduler):
    """The patient of the highest rank among those who fit into the nurse's capacity, ties to the lowest slot."""

    heeds_objective = False

    def __init__(self, name: str, rank: Callable[[np.ndarray], np.ndarray]) -> None:
        self.name, self._rank = name, rank

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,); `uniform` is not used."""
        patient = np.asarray(observation["patient"])
        spare = CAPACITY - STATE.read(np.asarray(observation["state"]), "own_load")
        fits = (np.asarray(observation["action_mask"]) > 0) & (LOAD[stages(patient)] <= spare[:, None])
        fits[:, 0] = False
        return best_action(self._rank(patient), fits)


def stages(patient: np.ndarray) -> np.ndarray:
    """Stage of each patient, int64 (B, P + 1), from float32 (B, P + 1, f); `early` for slots that hold nobody."""
    first = PATIENT.index(STAGES[0])
    return patient[..., first : first + len(STAGES)].argmax(axis=-1)


def slack(patient: np.ndarray) -> np.ndarray:
    """Expected quarters until birth begins, less those until a nurse has taken over the patient, float64 (B, P + 1)."""
    first = PATIENT.read(patient, "first_birth").astype(np.int64)
    stage = stages(patient)
    until = np.zeros_like(MEAN_QUARTERS)
    until[:, :BIRTH] = MEAN_QUARTERS[:, BIRTH - 1 :: -1].cumsum(axis=1)[:, ::-1]
    until[:, RECOVERY] = _NEVER
    handling = np.where(PATIENT.read(patient, "in_bed") > 0, HANDOVER, ADMISSION)
    return until[first, stage] - PATIENT.read(patient, "distance") - handling


def first_come() -> PriorityRule:
    """Whoever arrived first."""
    return PriorityRule("first-come", lambda patient: PATIENT.read(patient, "stay"))


def most_urgent() -> PriorityRule:
    """Whoever costs most an hour without a nurse."""
    return PriorityRule("most-urgent", lambda patient: PATIENT.read(patient, "neglect_cost"))


def least_slack() -> PriorityRule:
    """Whoever has the least time left until birth."""
    return PriorityRule("least-slack", lambda patient: -slack(patient))


class MarginalCost(ObservationScheduler):
    """The patient whose takeover saves most cost within `horizon` quarters; nobody where none saves any.

    By default the horizon is as long as an admission takes: a nurse leaves patients alone only for somebody who costs
    more meanwhile than all of them. With longer horizons nurses take over more patients than they can care for in the
    end. Raises InvalidOptionError for a horizon below one quarter.
    """

    name = "marginal-cost"
    heeds_objective = False

    def __init__(self, horizon: int = ADMISSION) -> None:
        self._horizon = require_integer("marginal-cost: horizon", horizon, 1, MOST_QUARTERS, "quarters of an hour")

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,); `uniform` is not used."""
        saved = self.savings(observation)
        return best_action(saved, saved > 0)

    def savings(self, observation: Observation) -> np.ndarray:
        """Cost that taking over each patient saves, float64 (B, P + 1); 0 for nobody, -inf where it is not legal."""
        return savings_of(
            np.require(observation["patient"], np.float32, ["C", "W"]),
            np.require(observation["action_mask"], np.int8, ["C", "W"]),
            expected_rates(self._horizon),
            self._horizon,
        )

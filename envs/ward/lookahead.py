"""What a takeover saves and what it costs, from what one nurse sees: expected costs over a short horizon."""

from __future__ import annotations

from functools import cache

import numpy as np

from marl_sched.envs.ward.dynamics import (
    ADMISSION,
    CAPACITY,
    HANDOVER,
    HIGH_RISK_FACTOR,
    LOAD,
    ORDER_OF_CARE,
    PROGRESS,
    RECOVERY,
    UNATTENDED_COST,
    WAITING_COST,
)
from marl_sched.envs.ward.features import DISTANCE, FIRST, HIGH_RISK, IN_BED, MINE, PATIENT, STAGE
from marl_sched.envs.ward.instance import QUARTERS
from marl_sched.kernels import kernel

_DISTANCE_SCALE = PATIENT.scale("distance")
_STAGES = len(LOAD)


@cache
def expected_rates(horizon: int) -> np.ndarray:
    """Mean cost an hour, over the next `horizon` quarters, of a patient for whom nobody cares.

    Float64 (2, 2, 4): whether she is in bed, whether it is her first birth, her stage now. Labour progresses; recovery
    does not, without care.
    """
    rates = np.zeros((2, 2, _STAGES))
    for first in range(2):
        move = np.eye(_STAGES)
        for stage in range(RECOVERY):
            move[stage, stage] -= PROGRESS[first, stage]
            move[stage, stage + 1] += PROGRESS[first, stage]
        now = np.eye(_STAGES)
        for _ in range(horizon):
            rates[0, first] += now @ WAITING_COST / horizon
            rates[1, first] += now @ UNATTENDED_COST / horizon
            now = now @ move
    return rates


@kernel(inline="always")
def _stage(features: np.ndarray) -> int:
    """The stage of a patient from her features float32 (f,)."""
    for stage in range(_STAGES):
        if features[STAGE + stage] > 0:
            return stage
    return 0


@kernel(inline="always")
def _rate(features: np.ndarray, in_bed: int, rates: np.ndarray) -> float:
    """A patient's expected cost an hour without care."""
    rate = rates[in_bed, int(features[FIRST]), _stage(features)]
    return rate * HIGH_RISK_FACTOR if features[HIGH_RISK] > 0 else rate


@kernel
def missed(patient: np.ndarray, own: np.ndarray, count: int, rates: np.ndarray) -> float:
    """Expected cost an hour of those among the first `count` slots of `own` who go without care from one nurse."""
    left, cost = CAPACITY, 0.0
    for stage in ORDER_OF_CARE:
        for high_risk in (True, False):
            for k in range(count):
                features = patient[own[k]]
                if _stage(features) != stage or (features[HIGH_RISK] > 0) != high_risk:
                    continue
                if LOAD[stage] <= left:
                    left -= LOAD[stage]
                else:
                    cost += _rate(features, 1, rates)
    return cost


@kernel
def savings(patient: np.ndarray, legal: np.ndarray, rates: np.ndarray, horizon: int, out: np.ndarray) -> None:
    """Write the cost that each takeover saves within `horizon` quarters, float64 (P + 1,); -inf where it is not legal.

    `patient` float32 (P + 1, f) and `legal` int8 (P + 1,) are an observation's, `rates` those of `expected_rates`.
    While the nurse walks and takes over, all patients whom she has go without care; afterwards those do who do not fit
    into her capacity. Doing nothing saves nothing.
    """
    own = np.zeros(len(legal) + 1, np.int64)
    out[0] = 0.0
    count, of_all = 0, 0.0
    for slot in range(1, len(legal)):
        out[slot] = -np.inf
        if patient[slot, MINE] > 0:
            own[count] = slot
            count += 1
            of_all += _rate(patient[slot], 1, rates)
    before = missed(patient, own, count, rates)
    for slot in range(1, len(legal)):
        if legal[slot] == 0:
            continue
        features = patient[slot]
        in_bed = int(features[IN_BED] > 0)
        walk = round(features[DISTANCE] * _DISTANCE_SCALE)
        away = walk + (HANDOVER if in_bed else ADMISSION)
        own[count] = slot
        after = missed(patient, own, count + 1, rates)
        without = horizon * (_rate(features, in_bed, rates) + before)
        taken = away * of_all + walk * _rate(features, 1, rates) + max(horizon - away, 0) * after
        out[slot] = (without - taken) / QUARTERS


@kernel
def savings_of(patient: np.ndarray, legal: np.ndarray, rates: np.ndarray, horizon: int) -> np.ndarray:
    """`savings` of B observations, float64 (B, P + 1)."""
    out = np.empty(legal.shape)
    for b in range(len(legal)):
        savings(patient[b], legal[b], rates, horizon, out[b])
    return out

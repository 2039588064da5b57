"""What every choice would cost if all nurses went on by `marginal-cost`: the roll-out algorithm as a teacher.

For the best of the acting nurse's legal choices the ward is played on for some hours by the rule, each nurse deciding
on what she sees, with noise drawn anew; choices are compared under the same noise (Bertsekas, Tsitsiklis, Wu 1997).
"""

from __future__ import annotations

from typing import cast

import numpy as np

from marl_sched.agents.base import CostScheduler
from marl_sched.envs.ward.dynamics import COST, Rules, State, step
from marl_sched.envs.ward.features import RANK
from marl_sched.envs.ward.graph import Arrays, observe_row
from marl_sched.envs.ward.simulator import WardSimulator, new_state
from marl_sched.errors import require_integer
from marl_sched.kernels import kernel
from marl_sched.noise import episode_key
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator

CANDIDATES = 6  # of the rule's ranking that are rolled out, doing nothing always among them


@kernel
def copy_row(state: State, b: int, trial: State) -> None:
    """Make row 0 of `trial` stand where row b stands."""
    trial.rows[0] = state.rows[b]
    for slot in range(state.patients.shape[1]):
        trial.patients[0, slot] = state.patients[b, slot]
    for n in range(state.nurses.shape[1]):
        trial.nurses[0, n] = state.nurses[b, n]
    for k in range(state.beds.shape[1]):
        trial.beds[0, k] = state.beds[b, k]


@kernel
def roll_out(trial: State, rules: Rules, limits: np.ndarray, choice: int, quarters: int, out: Arrays) -> float:
    """Take a choice, then go on by the rule for so many quarters or to the end; what the objective grew by."""
    row, actions = trial.rows[0], np.zeros(1, np.int64)
    before = row["cost"] if rules.objective == COST else row["census"]
    until = row["time"] + quarters
    actions[0] = choice
    step(trial, rules, actions)
    while row["acting"] >= 0 and row["time"] < until:
        observe_row(trial, 0, row["acting"], limits, out)
        for slot in range(len(out.action_mask[0])):
            if out.action_mask[0, slot] > 0 and out.patient[0, slot, RANK] == 0:
                actions[0] = slot
        step(trial, rules, actions)
    return (row["cost"] if rules.objective == COST else row["census"]) - before


@kernel
def costs_of_choices(
    state: State,
    rules: Rules,
    limits: np.ndarray,
    legal: np.ndarray,
    quarters: int,
    samples: int,
    trial: State,
    out: Arrays,
    costs: np.ndarray,
) -> None:
    """Write mean costs float64 (B, P + 1); inf for choices that are not legal or far behind in the rule's ranking."""
    for b in range(len(costs)):
        costs[b] = np.inf
        agent = state.rows[b]["acting"]
        if agent < 0:
            continue
        costs[b, 0] = 0.0
        if legal[b].sum() == 1:
            continue
        copy_row(state, b, trial)
        observe_row(trial, 0, agent, limits, out)
        rank = out.patient[0, :, RANK].copy()
        worst = (CANDIDATES - 0.5) / 10
        for slot in range(legal.shape[1]):
            if legal[b, slot] == 0 or (slot > 0 and rank[slot] > worst):
                continue
            costs[b, slot] = 0.0
            for sample in range(samples):
                copy_row(state, b, trial)
                trial.rows[0]["episode"] = episode_key(state.rows[b]["episode"], state.rows[b]["time"], sample)
                costs[b, slot] += roll_out(trial, rules, limits, slot, quarters, out) / samples


class MarginalCostRollout(CostScheduler):
    """Takes the choice of least cost, ties to the lower slot.

    It knows the whole ward and who will arrive, not how labour will go. Args:
        quarters: of an hour that are played on.
        samples: of the noise.

    Raises InvalidOptionError for a number below one.
    """

    name = "marginal-cost-rollout"
    privileged_info = PrivilegedInfo.PLACES | PrivilegedInfo.ARRIVALS

    def __init__(self, quarters: int = 12, samples: int = 16) -> None:
        self._quarters = require_integer(f"{self.name}: quarters", quarters, 1, 1_000_000)
        self._samples = require_integer(f"{self.name}: samples", samples, 1, 65_536)

    def costs(self, simulator: TurnSimulator, legal: np.ndarray) -> np.ndarray:
        """See costs_of_choices."""
        ward = cast(WardSimulator, simulator)
        state, costs = ward.state, np.full(legal.shape, np.inf)
        trial = new_state(1, ward.max_actions - 1, ward.max_agents, state.beds.shape[1], (0, 0, 0))
        out = Arrays(*[ward.arrays[name].empty(1) for name in Arrays._fields])
        limits = np.array(ward.view.limits)
        costs_of_choices(state, ward.rules, limits, legal, self._quarters, self._samples, trial, out, costs)
        return costs

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Slots int64 (B,)."""
        return self.costs(simulator, simulator.legal()).argmin(axis=1)

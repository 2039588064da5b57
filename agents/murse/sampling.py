"""The best of several schedules that a trained policy samples: what more time buys a policy that plans.

When a round begins, copies of it are played to its end in one batch, the first by the policy's most probable choices,
the others by sampling. Their orders of dispatch are timed on the durations that the team counts on, and the best one is
followed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marl_sched.agents.base import inverse_distribution
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.problem import Plan, plan_cost, timed
from marl_sched.agents.murse.snapshot import as_murse, estimated_round
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator

if TYPE_CHECKING:
    from marl_sched.agents.policies.network_policy import NetworkPolicy


class BestOfSamples(PlanningScheduler):
    """Plans a round by the best of a policy's schedules, the greedy one among them; ties to the first.

    Args:
        policy: trained on MuRSE's metagraph.
        samples: schedules for each round.

    Raises InvalidOptionError for fewer than one, and when it is to play in `online` mode or under a local view.
    """

    def __init__(self, policy: NetworkPolicy, samples: int) -> None:
        super().__init__()
        if samples < 1:
            raise InvalidOptionError(f"{policy.name}: samples: expected an integer >= 1, got {samples}")
        self.name = f"{policy.name}@samples={samples}"
        self._policy, self._samples = policy, samples

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """See PlanningScheduler."""
        murse = as_murse(simulator)
        if murse.mode != "plan" or murse.view.hides:
            raise InvalidOptionError(
                f"{self.name}: plans whole rounds: expected mode plan and the full view, "
                f"got mode {murse.mode} and view {murse.view.kind}"
            )
        super().start(simulator, envs)

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The best schedule of a row's present round, by feasibility and then by the objective."""
        problem, number = estimated_round(simulator, env_index), int(simulator.state.rows["round"][env_index])
        copies = copies_of(simulator, env_index, self._samples)
        rng = np.random.default_rng([int(simulator.state.rows["episode"][env_index]), number])
        while (rows := np.flatnonzero((copies.acting != NOBODY) & (copies.progress == number))).size:
            copies.step(self._choices(copies, rows, rng))
        plans = [timed(problem, *dispatched(copies, row, number)) for row in range(self._samples)]
        return min(plans, key=lambda plan: plan_cost(problem, plan, simulator.objective))

    def _choices(self, copies: MurseSimulator, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Targets int64 (K,): row 0 takes the likeliest, others sample; any legal one where the round is over."""
        acting, observation = copies.observe_acting()
        targets = np.zeros(copies.batch, np.int64)
        targets[acting] = (observation["action_mask"] != 0).argmax(axis=1)
        kept = np.isin(acting, rows)
        logits = self._policy.logits({name: values[kept] for name, values in observation.items()})
        targets[rows] = inverse_distribution(logits, rng.random(copies.batch)[rows])
        if rows[0] == 0:
            targets[0] = logits[0].argmax()
        return targets


def copies_of(simulator: MurseSimulator, env_index: int, count: int) -> MurseSimulator:
    """A simulator whose rows all stand where one row of another stands, without its padding."""
    copies = MurseSimulator(
        [simulator.instances[env_index]] * count,
        view=simulator.view,
        objective=simulator.objective,
        horizon=simulator.horizon,
        mode=simulator.mode,
        simplification=simulator.simplification,
    )
    there = simulator.live_arrays()
    for name, array in copies.live_arrays().items():
        if name.startswith("state."):
            array[...] = there[name][env_index][tuple(slice(length) for length in array.shape[1:])]
    copies.rules = simulator.rules
    return copies


def dispatched(simulator: MurseSimulator, env_index: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Tasks and agents of an ended round in the order of dispatch, int64 (K,) each."""
    done = simulator.state.executed[env_index, number]
    tasks = np.flatnonzero(done["agent"] != NOBODY)
    tasks = tasks[np.argsort(done["position"][tasks], kind="stable")]
    return tasks, done["agent"][tasks].astype(np.int64)

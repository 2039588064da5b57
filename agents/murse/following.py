"""Schedulers that make a plan and take the simulator's turns by it."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from marl_sched.agents.base import EpochPlayer, Scheduler
from marl_sched.agents.murse.problem import Plan
from marl_sched.agents.murse.snapshot import as_murse
from marl_sched.agents.murse.whole_rounds import round_player
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator


class PlanningScheduler(Scheduler):
    """Makes a plan when a round begins and follows it turn by turn; `plan` is what a subclass adds.

    An agent takes its next task as soon as all that stand before it in the plan and are near or waited for have
    been dispatched, and waits until then. Where durations are as planned, every task then starts as planned. A
    task that the plan leaves out is never done.
    """

    privileged_info = PrivilegedInfo.DURATIONS | PrivilegedInfo.WAITS | PrivilegedInfo.DEADLINES | PrivilegedInfo.PLACES

    def __init__(self) -> None:
        self._rounds: np.ndarray = np.empty(0, np.int64)
        self._plans: list[Plan | None] = []

    @abstractmethod
    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """A plan for the present round of a row, whose first turn it is."""

    def revise(self, simulator: MurseSimulator, env_index: int, plan: Plan) -> Plan:
        """The plan to go on with, asked before every turn but a round's first; by default the same."""
        return plan

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Forget the rows' plans; new ones are made at their next turns."""
        if len(self._rounds) != simulator.batch:
            self._rounds, self._plans = np.full(simulator.batch, -1), [None] * simulator.batch
        self._rounds[envs] = -1

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer | None:
        """Plays each plan as a whole round where nothing can be revised in between."""
        return round_player(as_murse(simulator), self.plan)

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,)."""
        murse = as_murse(simulator)
        actions = np.zeros(murse.batch, np.int64)
        rounds = murse.state.rows["round"]
        for row in np.flatnonzero(murse.acting != NOBODY).tolist():
            plan = self._plans[row]
            if plan is None or self._rounds[row] != rounds[row]:
                plan, self._rounds[row] = self.plan(murse, row), rounds[row]
            else:
                plan = self.revise(murse, row, plan)
            self._plans[row] = plan
            actions[row] = next_action(murse, row, plan)
        return actions


def next_action(simulator: MurseSimulator, env_index: int, plan: Plan) -> int:
    """The acting agent's next action by the plan: the slot of its next task, or 0 while that has to wait."""
    agent = int(simulator.acting[env_index])
    done = simulator.state.tasks["agent"][env_index] != NOBODY
    own = plan.tasks[(plan.agents == agent) & ~done[plan.tasks]]
    if len(own) == 0:
        return 0
    task = int(own[0])
    place = int(np.flatnonzero(plan.tasks == task)[0])
    ahead = plan.tasks[:place]
    held = simulator.state.near[env_index, task, ahead] & ~done[ahead]
    return 0 if held.any() or not simulator.dispatchable(env_index, task, agent) else task + 1

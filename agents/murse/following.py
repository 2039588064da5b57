"""Schedulers that plan a round of MuRSE and take the simulator's turns by it (marl_sched.agents.planning)."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from marl_sched.agents.base import EpochPlayer
from marl_sched.agents.murse.problem import Plan
from marl_sched.agents.murse.snapshot import as_murse
from marl_sched.agents.murse.whole_rounds import round_player
from marl_sched.agents.planning import TeamPlanner
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator


class PlanningScheduler(TeamPlanner[Plan]):
    """Makes a plan when a round begins and follows it turn by turn; `plan` is what a subclass adds.

    A plan holds for its round, and `revise` is asked before every turn but a round's first. An agent takes its next
    task as soon as all that stand before it in the plan and are near or waited for have been dispatched, and waits
    until then. Where durations are as planned, every task then starts as planned. A task that the plan leaves out is
    never done.
    """

    privileged_info = PrivilegedInfo.DURATIONS | PrivilegedInfo.WAITS | PrivilegedInfo.DEADLINES | PrivilegedInfo.PLACES

    @abstractmethod
    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """A plan for the present round of a row, whose first turn it is."""

    def holds(self, simulator: MurseSimulator, env_index: int, plan: Plan) -> bool:
        """Whether the plan was made in the present round."""
        return bool(simulator.state.rows["round"][env_index] == self.planned_at[env_index])

    def next_action(self, simulator: MurseSimulator, env_index: int, plan: Plan) -> int:
        """See `next_action`."""
        return next_action(simulator, env_index, plan)

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer | None:
        """Plays each plan as a whole round where nothing can be revised in between."""
        return round_player(as_murse(simulator), self.plan)

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,)."""
        return super().decide(as_murse(simulator))


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

"""Schedulers whose agents share out a round's tasks by messages before it begins, then each follow their own list."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.agents.murse.auctions.agent_schedule import UNKNOWN, AgentSchedule
from marl_sched.agents.murse.auctions.cbba import CbbaBidder
from marl_sched.agents.murse.auctions.network import Bidder, hearing, negotiate
from marl_sched.agents.murse.auctions.tessi import TessiBidder
from marl_sched.agents.murse.latest_start import common_horizon, latest_starts
from marl_sched.agents.murse.snapshot import as_murse, estimated_round
from marl_sched.agents.murse.traffic import Traffic
from marl_sched.agents.murse.windows import induced_deadlines
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.errors import InvalidOptionError
from marl_sched.privileged import PrivilegedInfo
from marl_sched.simulation import TurnSimulator

_TURNS_PER_TASK = 100


class NegotiatingScheduler(Scheduler):
    """Negotiates on estimated durations at the beginning of every round; `bidder` is what a subclass adds.

    Before a round agents hear those within `radius` of their stations (marl_sched.agents.murse.auctions.network), None:
    as far as the simulator's view lets them, so everybody under the full view. Afterwards they say nothing more:
    an agent comes to a task that another one has taken if it did not hear of it, which is a conflict, and then
    crosses it off its list.

    What a task with a deadline waits for has to end in time for it; everybody knows the waits and deadlines.

    Attributes:
        traffic: messages and bytes by row and round.
    """

    privileged_info = PrivilegedInfo.DURATIONS | PrivilegedInfo.WAITS | PrivilegedInfo.DEADLINES | PrivilegedInfo.PLACES

    def __init__(self, radius: float | None = None) -> None:
        if radius is not None and not radius >= 0:
            raise InvalidOptionError(f"{self.name}: radius: expected a number >= 0, got {radius}")
        self._radius = radius
        self.traffic = Traffic()
        self._rounds = np.empty(0, np.int64)
        self._schedules: list[list[AgentSchedule]] = []

    @abstractmethod
    def bidder(self, schedule: AgentSchedule, n_agents: int) -> Bidder:
        """An agent's side of the negotiation."""

    def per_round(self) -> dict[str, np.ndarray]:
        """Messages and bytes."""
        return self.traffic.per_round()

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Forget what the rows' agents agreed on."""
        self.traffic.restart(as_murse(simulator), envs)
        if len(self._rounds) != simulator.batch:
            self._rounds, self._schedules = np.full(simulator.batch, -1), [[] for _ in range(simulator.batch)]
        self._rounds[envs] = -1

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Actions int64 (B,): each acting agent's next task by its own schedule."""
        murse, actions = as_murse(simulator), np.zeros(simulator.batch, np.int64)
        rounds = murse.state.rows["round"]
        for row in np.flatnonzero(murse.acting != NOBODY).tolist():
            if self._rounds[row] != rounds[row]:
                self._negotiate(murse, row)
                self._rounds[row] = rounds[row]
            actions[row] = next_own(murse, row, self._schedules[row][int(murse.acting[row])])
        return actions

    def _negotiate(self, simulator: MurseSimulator, env_index: int) -> None:
        problem, instance = estimated_round(simulator, env_index), simulator.instances[env_index]
        deadlines = induced_deadlines(problem)
        schedules = [
            AgentSchedule(agent, problem.durations, problem.lags, problem.near, deadlines)
            for agent in range(problem.n_agents)
        ]
        bidders = [self.bidder(schedule, problem.n_agents) for schedule in schedules]
        radius = simulator.view.limits[1] if self._radius is None else self._radius
        hears = hearing(problem.n_agents, instance.map_width, radius)
        talk = negotiate(bidders, hears, _TURNS_PER_TASK * problem.n_tasks)
        self.traffic.add(simulator, env_index, talk.messages, talk.bytes)
        self._schedules[env_index] = schedules


def next_own(simulator: MurseSimulator, env_index: int, schedule: AgentSchedule) -> int:
    """The action of the next task on an agent's own list, or 0 while it has to wait.

    It goes for a task that is taken if it has not heard of that. It waits until what the task waits for and near
    tasks that it believes to come before have been dispatched.
    """
    agent, tasks = schedule.agent, simulator.state.tasks
    holders = tasks["agent"][env_index]
    told = simulator.state.private_memory[env_index, agent, :, 1] >= 0
    for task in schedule.path:
        if holders[task] == agent or told[task]:
            continue
        if holders[task] != NOBODY:
            return task + 1
        before = (schedule.starts != UNKNOWN) & (schedule.starts < schedule.starts[task]) & schedule.near[task]
        open_before = before & (holders[: len(before)] == NOBODY)
        return 0 if open_before.any() or not simulator.dispatchable(env_index, task, agent) else task + 1
    return 0


class Tessi(NegotiatingScheduler):
    """Sequential single-item auctions with a temporal-network test, see marl_sched.agents.murse.auctions.tessi."""

    name = "tessi"

    def bidder(self, schedule: AgentSchedule, n_agents: int) -> Bidder:
        """A bidder of TeSSI."""
        return TessiBidder(schedule, np.zeros(len(schedule.holder), np.int64))


class TessiSlack(NegotiatingScheduler):
    """TeSSI in which agents bid on the task of the least latest start first, as the rule `lst` ranks them."""

    name = "tessi-slack"

    def bidder(self, schedule: AgentSchedule, n_agents: int) -> Bidder:
        """A bidder of TeSSI who knows the latest starts."""
        keys = latest_starts(schedule.durations, schedule.lags, schedule.deadlines, common_horizon(schedule.durations))
        return TessiBidder(schedule, np.floor(keys).astype(np.int64))


class Cbba(NegotiatingScheduler):
    """The consensus-based bundle algorithm with a temporal-network test, see marl_sched.agents.murse.auctions.cbba."""

    name = "cbba"

    def bidder(self, schedule: AgentSchedule, n_agents: int) -> Bidder:
        """A bidder of CBBA."""
        return CbbaBidder(schedule, n_agents)

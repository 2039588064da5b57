"""The plant: what the world process owns. A simulator here; whoever has a real one writes the same few methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import msgspec
import numpy as np

from marl_sched.comms.protocol.events import Choice, Outcome, PlantAdvanced, Request
from marl_sched.domain import Domain, Telemetry
from marl_sched.graph import ACTION_MASK, VISIBLE_SHARE
from marl_sched.simulation import TurnSimulator

IDLE = 0


class Commit(msgspec.Struct, frozen=True, kw_only=True):
    """What became of one agent's turn.

    Attributes:
        tick: simulated time of the turn.
        action: what the agent chose; unless the outcome is `decided` or `conflict` it did nothing instead.
        reward: the team's, of the time that passed after this turn.
        share: of the graph that the agent saw.
    """

    tick: int
    agent: int
    action: int
    outcome: Outcome
    reward: float
    share: float


class Plant(Protocol):
    """What is scheduled. Its methods are called one at a time, by one thread.

    Attributes:
        n_agents: how many agents decide.
        frame: what every agent is told at the start.
        channels: for each agent the channels that it may hear.
    """

    n_agents: int
    frame: bytes
    channels: Sequence[Sequence[str]]

    def state(self) -> PlantAdvanced:
        """Where the plant stands now, with every channel that changed since the last call."""

    def apply(self, choices: Sequence[Choice]) -> list[Commit]:
        """Carry out what the agents chose, in this order, and go on until somebody is to decide again."""

    def summary(self) -> dict[str, Any]:
        """The plant's part of the report."""


class SimulatedPlant:
    """A domain's simulator, batch element 0, with agents in turn; see Plant."""

    def __init__(self, domain: Domain, telemetry: Telemetry, simulator: TurnSimulator) -> None:
        self.domain, self.telemetry, self.simulator = domain, telemetry, simulator
        self.n_agents = int(simulator.n_agents[0])
        self.frame = telemetry.frame(simulator)
        self.channels: Sequence[Sequence[str]] = [
            telemetry.local_state(self.frame, agent).channels for agent in range(self.n_agents)
        ]
        self._said: dict[str, bytes] = {}
        self._observation = simulator.new_observation()

    def state(self) -> PlantAdvanced:
        """See Plant.state."""
        changed = {}
        for channel, payload in self.telemetry.messages(self.simulator).items():
            if self._said.get(channel) != payload:
                self._said[channel] = changed[channel] = payload
        tick = int(self.simulator.time[0])
        if self.simulator.over[0]:
            return PlantAdvanced(tick, (), changed, over=True)
        return PlantAdvanced(tick, (self._request(int(self.simulator.acting[0])),), changed)

    def _request(self, agent: int) -> Request:
        return Request(agent, float(self.simulator.policy_noise(np.array([agent]))[0]))

    def apply(self, choices: Sequence[Choice]) -> list[Commit]:
        """See Plant.apply."""
        return [self._apply(choice) for choice in choices]

    def _apply(self, choice: Choice) -> Commit:
        simulator, tick = self.simulator, int(self.simulator.time[0])
        observation = simulator.observe(np.array([choice.agent]), self._observation)
        outcome = choice.outcome
        if choice.action >= simulator.max_actions or not observation[ACTION_MASK][0, choice.action]:
            outcome = Outcome.ILLEGAL
        simulator.step(np.array([IDLE if outcome == Outcome.ILLEGAL else choice.action]))
        if simulator.conflict[0]:
            outcome = Outcome.CONFLICT
        return Commit(
            tick=tick,
            agent=choice.agent,
            action=choice.action,
            outcome=outcome,
            reward=float(simulator.reward[0]),
            share=float(observation[VISIBLE_SHARE][0]),
        )

    def summary(self) -> dict[str, Any]:
        """See Plant.summary: simulated time, objectives, and their series."""
        objectives = {name: float(values[0]) for name, values in self.simulator.objectives().items()}
        series = self.telemetry.series(self.simulator)
        return {"time": int(self.simulator.time[0]), "objectives": objectives, **series}

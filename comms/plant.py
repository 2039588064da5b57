"""The plant: what the world process owns. A simulator here; whoever has a real one writes the same few methods.

A world plays a plant of one's own if it is told the function that makes it, `marl-sched world --plant mine.plant:make`,
which gets the WorldOptions and returns a Plant. What agents are told, frame and channels, is in the form of the
telemetry of the domain that `--env` names, so that agents and policies need not know the difference.
examples/recorded_plant.py is one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

import msgspec
import numpy as np

from marl_sched.comms.protocol.events import Choice, Outcome, PlantAdvanced, Request
from marl_sched.comms.protocol.messages import Operator, Work
from marl_sched.domain import Domain
from marl_sched.domain_parts import Telemetry
from marl_sched.graph import ACTION_MASK, VISIBLE_SHARE
from marl_sched.noise import Stream, uniforms
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


class PlantSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The plant's part of a report.

    Attributes:
        time: simulated time.
        progress: how much of the horizon has passed, in its unit.
        objectives: means over the run so far, by name.
        series: objectives of every unit of time so far.
        agent_figures: what every agent did so far, one value for each (`TurnSimulator.agent_figures`).
    """

    time: int
    progress: int
    objectives: dict[str, float]
    series: dict[str, list[float]]
    agent_figures: dict[str, list[float]]

    def of_agent(self, agent: int) -> dict[str, float]:
        """The figures of one agent, by name."""
        return {name: values[agent] for name, values in self.agent_figures.items()}


class Plant(Protocol):
    """What is scheduled. Its methods are called one at a time, by one thread.

    A choice may be asked for before its agent's turn, where nothing that happens before can change it. The plant keeps
    it until then.

    Nobody asks the plant to wait: where time passes by itself, `state` says what is to be decided now, and may say that
    nothing is. It is then asked again after WorldRules.poll seconds.

    Attributes:
        simulated: whether it stands still while nobody calls it, and does the same again: a world that is restarted
            then plays its log again. One that is not stays as it is, and the log is only continued.
        n_agents: how many agents decide.
        frame: what every agent is told at the start.
        channels: for each agent the channels that it may hear.
    """

    simulated: bool
    n_agents: int
    frame: bytes
    channels: Sequence[Sequence[str]]

    def state(self) -> PlantAdvanced:
        """Where the plant stands now, with every channel that changed since the last call."""

    def apply(self, choices: Sequence[Choice]) -> list[Commit]:
        """Carry out what the agents chose, each in its turn, and go on until somebody is to decide again.

        Returns what was carried out, in order; what is kept for later is not in it.
        """

    def order(self, order: Work | Operator) -> str | None:
        """Carry out an operator's order; why it is impossible here, None if it holds from now on."""

    def objectives(self) -> dict[str, float]:
        """The objectives so far, by name."""

    def summary(self) -> PlantSummary:
        """The plant's part of the report."""


class SimulatedPlant:
    """A domain's simulator, batch element 0, with agents in turn; see Plant.

    Agents that are to decide at one decision epoch are asked at once as far as none of them hears a channel that the
    turn of one before it can change: what they see, and so what they choose, is what it would be in their turn.
    """

    simulated = True

    def __init__(self, domain: Domain, telemetry: Telemetry, simulator: TurnSimulator) -> None:
        self.domain, self.telemetry, self.simulator = domain, telemetry, simulator
        self.n_agents = int(simulator.n_agents[0])
        self.frame = telemetry.frame(simulator)
        self.channels: Sequence[Sequence[str]] = [
            telemetry.local_state(self.frame, agent).channels for agent in range(self.n_agents)
        ]
        self._hears = [frozenset(channels) for channels in self.channels]
        self._said: dict[str, bytes] = {}
        self._stale: set[str] | None = None  # channels that may have changed since they were encoded, None: all
        self._kept: dict[int, Choice] = {}  # of agents whose turn has not come yet
        self._observation = simulator.new_observation()

    def state(self) -> PlantAdvanced:
        """See Plant.state."""
        tick, progress, changed = int(self.simulator.time[0]), int(self.simulator.progress[0]), self._changed()
        if self.simulator.over[0]:
            return PlantAdvanced(tick, (), changed, over=True, progress=progress)
        return PlantAdvanced(tick, tuple(self._request(agent) for agent in self._askable()), changed, progress=progress)

    def _changed(self) -> dict[str, bytes]:
        """The channels that changed since the last call; only what the last turns can have changed is encoded."""
        changed = {}
        for channel, payload in self.telemetry.messages(self.simulator, self._stale).items():
            if self._said.get(channel) != payload:
                self._said[channel] = changed[channel] = payload
        self._stale = set()
        return changed

    def _askable(self) -> list[int]:
        """The acting agent, and those behind it whose observations no turn before theirs can change."""
        acting = int(self.simulator.acting[0])
        behind = [agent for agent in self.simulator.free_agents(0).tolist() if agent != acting]
        asked, touched = [], set[str]()
        for agent in [acting, *behind]:
            if touched.isdisjoint(self._hears[agent]):
                asked.append(agent)
            touched.update(self.telemetry.turn_channels(self.simulator, agent))
        return [agent for agent in asked if agent not in self._kept]

    def _request(self, agent: int) -> Request:
        return Request(agent, float(self.simulator.policy_noise(np.array([agent]))[0]))

    def apply(self, choices: Sequence[Choice]) -> list[Commit]:
        """See Plant.apply."""
        self._kept.update((choice.agent, choice) for choice in choices)
        commits = []
        while (agent := int(self.simulator.acting[0])) in self._kept:
            commits.append(self._apply(self._kept.pop(agent)))
        return commits

    def _apply(self, choice: Choice) -> Commit:
        simulator, tick = self.simulator, int(self.simulator.time[0])
        observation = simulator.observe(np.array([choice.agent]), self._observation)
        outcome = choice.outcome
        if choice.action >= simulator.max_actions or not observation[ACTION_MASK][0, choice.action]:
            outcome = Outcome.ILLEGAL
        touched = self.telemetry.turn_channels(simulator, choice.agent)
        simulator.step(np.array([IDLE if outcome == Outcome.ILLEGAL else choice.action]))
        self._note_passed(touched)
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

    def _note_passed(self, touched: Collection[str]) -> None:
        """Note what a step can have changed, and forget choices that were made on what is past."""
        if self.simulator.elapsed[0] > 0 or self.simulator.over[0]:
            self._stale = None
            self._kept.clear()
        elif self._stale is not None:
            self._stale.update(touched)
        for agent in [agent for agent in self._kept if not self._hears[agent].isdisjoint(touched)]:
            del self._kept[agent]  # somebody has become free, and acted before it

    def order(self, order: Work | Operator) -> str | None:
        """None of them can be carried out: the work of an instance and the choices of agents are given."""
        what = f"{order.kind} work" if isinstance(order, Work) else f"{order.kind} an agent's choices"
        return f"{self.domain.name} cannot {what} while it runs"

    def objectives(self) -> dict[str, float]:
        """See Plant.objectives."""
        return {name: float(values[0]) for name, values in self.simulator.objectives().items()}

    def summary(self) -> PlantSummary:
        """See Plant.summary."""
        objectives = self.objectives()
        series = self.telemetry.series(self.simulator)
        figures = {name: values[0].tolist() for name, values in self.simulator.agent_figures().items()}
        return PlantSummary(
            time=int(self.simulator.time[0]),
            progress=int(self.simulator.progress[0]),
            objectives=objectives,
            series=series,
            agent_figures=figures,
        )


class SimultaneousPlant(SimulatedPlant):
    """A domain's simulator in which all free agents choose at once, on the same state; see Plant.

    Where several choose one action, the one with the smallest uniform of stream CONFLICT at (time, action, agent) has
    it and the others meet a conflict, so a run equals that of the Parallel API with the same actions.
    """

    def state(self) -> PlantAdvanced:
        """See Plant.state."""
        self._stale = None  # several turns at once
        return super().state()

    def _askable(self) -> list[int]:
        """All that are free."""
        free: list[int] = self.simulator.free_agents(0).tolist()
        return free

    def apply(self, choices: Sequence[Choice]) -> list[Commit]:
        """See Plant.apply."""
        simulator, tick = self.simulator, int(self.simulator.time[0])
        actions, outcomes, shares, rewards = {}, {}, {}, dict.fromkeys((c.agent for c in choices), 0.0)
        for choice in choices:
            observation = simulator.observe(np.array([choice.agent]), self._observation)
            possible = choice.action < simulator.max_actions and observation[ACTION_MASK][0, choice.action]
            actions[choice.agent] = choice.action if possible else IDLE
            outcomes[choice.agent] = choice.outcome if possible else Outcome.ILLEGAL
            shares[choice.agent] = float(observation[VISIBLE_SHARE][0])
        losers = self._losers(actions)
        pending = set(actions)
        while pending:
            agent = min((a for a in simulator.free_agents(0).tolist() if a in pending), key=losers.__contains__)
            pending.remove(agent)
            simulator.give_turn(0, agent)
            simulator.step(np.array([actions[agent]]))
            rewards[agent] = float(simulator.reward[0])
            if simulator.conflict[0]:
                outcomes[agent] = Outcome.CONFLICT
            if simulator.over[0] or simulator.elapsed[0] > 0:
                break
        outcomes.update(dict.fromkeys(pending, Outcome.LAPSED))
        return [
            Commit(
                tick=tick,
                agent=choice.agent,
                action=choice.action,
                outcome=outcomes[choice.agent],
                reward=rewards[choice.agent],
                share=shares[choice.agent],
            )
            for choice in choices
        ]

    def _losers(self, actions: dict[int, int]) -> set[int]:
        """The agents whose action the draw gives to another."""
        best: dict[int, tuple[float, int]] = {}
        keys, time = self.simulator.episode_keys, self.simulator.time
        for agent, action in actions.items():
            if action != IDLE:
                bid = (float(uniforms(keys, time, Stream.CONFLICT, np.array([action]), agent)[0]), agent)
                best[action] = min(best.get(action, bid), bid)
        return {agent for agent, action in actions.items() if action != IDLE and best[action][1] != agent}

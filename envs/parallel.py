"""PettingZoo Parallel: all agents that are free at a moment choose at once, on the same state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from marl_sched.domain import Domain
from marl_sched.envs.aec import refuse_scheme
from marl_sched.envs.single import SingleEpisode
from marl_sched.envs.spaces import action_space, graph_space, observation_space
from marl_sched.errors import IllegalActionError, UnknownNameError
from marl_sched.graph import ACTION_MASK, VISIBLE_SHARE
from marl_sched.noise import Stream, uniforms

Observations = dict[str, dict[str, Any]]
Infos = dict[str, dict[str, Any]]


class SchedulingParallel(ParallelEnv):
    """A domain as a PettingZoo Parallel environment, written by hand, not converted from AEC.

    One step is one moment: every free agent acts, and time passes until an agent is free again. Nobody sees
    what the others choose at this moment. Where several choose one target, the one with the smallest uniform of
    stream CONFLICT at (time, target, agent) has it. The others idle and their infos say `conflict`, as do those
    of agents whose choice was legal in their view and impossible in truth. A choice that the mask forbids idles
    the agent, and its info says `illegal`. Actions of busy agents are ignored; their masks allow only target 0.

    Observations and infos are those of SchedulingAEC, for all agents, with `illegal` added. Every agent's reward
    is the team's.

    Args:
        domain: a registered domain or its name.
        options: as SingleEpisode takes them, its `render_mode` included.
    """

    def __init__(self, domain: str | Domain, **options: Any) -> None:
        refuse_scheme(options)
        self._single = SingleEpisode(domain, **options)
        self.metadata = self._single.metadata
        self.render_mode = self._single.render_mode
        simulator = self.simulator = self._single.simulator
        self.possible_agents = [self._single.domain.agent_name(i) for i in range(simulator.max_agents)]
        self._observation_spaces = {agent: observation_space(simulator) for agent in self.possible_agents}
        self._action_spaces = {agent: action_space(simulator) for agent in self.possible_agents}
        self.state_space = graph_space(simulator.arrays)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space:
        """`Dict(observation=Dict(...), action_mask=Box)`, padded to the scale's largest instance."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """`Discrete(max_targets)`, padded to the scale's largest instance."""
        return self._action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Start episode 0 of `seed`, or the next episode; `options={"instance": ...}` gives its instance."""
        self._single.reset(seed, options)
        self.agents = self.possible_agents[: self.simulator.n_agents[0]]
        self._masks: dict[str, np.ndarray] = {}
        return self._look(set(), set())

    def _look(self, conflicts: set[int], illegal: set[int]) -> tuple[Observations, Infos]:
        """What every agent sees and is told; numbers of agents whose last choices failed."""
        observations: Observations = {}
        infos: Infos = {}
        for i, agent in enumerate(self.agents):
            seen = self._single.observe(i)
            mask = self._masks[agent] = seen.pop(ACTION_MASK)
            observations[agent] = {"observation": seen, ACTION_MASK: mask.copy()}
            infos[agent] = {
                ACTION_MASK: mask.copy(),
                "conflict": i in conflicts,
                "illegal": i in illegal,
                "time": int(self.simulator.time[0]),
                VISIBLE_SHARE: float(seen[VISIBLE_SHARE]),
            }
        return observations, infos

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Let all free agents act and time pass.

        Raises IllegalActionError for a choice outside the space, for a free agent without a choice and after
        the end, UnknownNameError for an agent that is not of this instance; nothing has happened then.
        """
        if not self.agents:
            raise IllegalActionError("step: the episode is over, call reset()")
        for agent in actions:
            if agent not in self._masks:
                raise UnknownNameError("agent", agent, self.agents)
        choices, illegal = self._choices(actions)
        losers = self._losers(choices)
        reward, conflicts = self._play({agent: 0 if agent in losers else choices[agent] for agent in choices})
        observations, infos = self._look(conflicts | losers, illegal)
        agents, over = self.agents, self._single.over
        if over:
            self.agents = []
        return (
            observations,
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, bool(self.simulator.terminated[0])),
            dict.fromkeys(agents, bool(self.simulator.truncated[0])),
            infos,
        )

    def _choices(self, actions: Mapping[str, Any]) -> tuple[dict[int, int], set[int]]:
        """The free agents' targets, illegal ones replaced by 0, and who chose those."""
        choices: dict[int, int] = {}
        illegal: set[int] = set()
        free = self.simulator.free_agents(0)
        for i, agent in enumerate(self.agents):
            if agent in actions:
                target = self._single.as_target(i, actions[agent])
            elif i in free:
                raise IllegalActionError(f"{agent}: is free and has no action")
            if i in free:
                if not self._masks[agent][target]:
                    illegal.add(i)
                    target = 0
                choices[i] = target
        return choices, illegal

    def _losers(self, choices: Mapping[int, int]) -> set[int]:
        """Who chose a target that the draw gives to another."""
        keys, time = self.simulator.episode_keys, self.simulator.time
        best: dict[int, tuple[float, int]] = {}
        for agent, target in choices.items():
            if target > 0:
                bid = (uniforms(keys, time, Stream.CONFLICT, np.array([target]), agent)[0], agent)
                best[target] = min(best.get(target, bid), bid)
        return {agent for agent, target in choices.items() if target > 0 and best[target][1] != agent}

    def _play(self, choices: dict[int, int]) -> tuple[float, set[int]]:
        """Take the moment's turns in the simulator's order; the team reward and who met with a conflict.

        A turn may end the moment for agents that have not had theirs, as the last task of a MuRSE round does;
        their choices lapse.
        """
        reward = 0.0
        conflicts: set[int] = set()
        simulator = self.simulator
        for _ in choices:
            agent = int(simulator.acting[0])
            reward += self._single.step(choices[agent])
            if simulator.conflict[0]:
                conflicts.add(agent)
            if self._single.over or simulator.elapsed[0] > 0:
                break
        return reward, conflicts

    def state(self) -> dict[str, np.ndarray]:
        """The full graph, arrays as `state_space` says; after the end no agent acts in it."""
        return self._single.state()

    def render(self) -> Any:
        """The picture of the chosen render mode: str for `ansi`, uint8 (H, W, 3) for `rgb_array`."""
        return self._single.render()

    def close(self) -> None:
        """Nothing is held open."""

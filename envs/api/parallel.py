"""PettingZoo Parallel: all agents that are free at a decision epoch choose at once, on the same state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv

from marl_sched.envs.api.base import SchedulingEnvironment
from marl_sched.errors import IllegalActionError, UnknownNameError
from marl_sched.graph import ACTION_MASK, VISIBLE_SHARE
from marl_sched.noise import Stream, uniforms

Observations = dict[str, Any]
Infos = dict[str, dict[str, Any]]

_CONFLICT = int(Stream.CONFLICT)


class SchedulingParallel(SchedulingEnvironment, ParallelEnv[str, Any, int]):
    """A domain as a PettingZoo Parallel environment, written by hand, not converted from AEC.

    One step is one decision epoch: every free agent acts, and time passes until an agent is free again. Nobody sees
    what the others choose at this decision epoch. Where several choose one action, the one with the smallest uniform of
    stream CONFLICT at (time, action, agent) has it. The others idle, learn of the action what a conflict tells
    and their infos say `conflict`, as do those of agents whose choice was legal in their view and impossible in
    truth. A choice that the mask forbids idles
    the agent, and its info says `illegal`. Actions of busy agents are ignored; their masks allow only action 0.

    Observations and infos are those of SchedulingAEC, for all agents, with `illegal` added. Every agent's reward
    is the team's.

    Args:
        domain: a registered domain or its name.
        options: as SingleEpisode takes them, its `render_mode` included.
    """

    changing = ("agents", "_masks", "_parts", "_single.position")

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Start episode 0 of `seed`, or the next episode; `options={"instance": ...}` gives its instance."""
        self._single.reset(seed, options)
        self.agents = self._present()
        self._masks: dict[str, np.ndarray] = {}
        self._parts: dict[str, float] = {}  # of the last step's reward
        return self._look(set(), set())

    def observe(self, agent: str) -> Any:
        """What an agent of this instance sees now, as `step` and `reset` return it; UnknownNameError for others."""
        if agent not in self.agents:
            raise UnknownNameError("agent", agent, self.agents)
        seen = self._single.observe(self.agents.index(agent))
        return self.layout.observation(seen, seen.pop(ACTION_MASK))

    def _look(self, conflicts: set[int], illegal: set[int]) -> tuple[Observations, Infos]:
        """What every agent sees and is told; numbers of agents whose last choices failed."""
        observations: Observations = {}
        infos: Infos = {}
        for i, agent in enumerate(self.agents):
            seen = self._single.observe(i)
            mask = self._masks[agent] = seen.pop(ACTION_MASK)
            share = float(seen[VISIBLE_SHARE])
            observations[agent] = self.layout.observation(seen, mask.copy())
            infos[agent] = {
                **self.layout.info(mask.copy()),
                "conflict": i in conflicts,
                "illegal": i in illegal,
                "time": int(self.simulator.time[0]),
                VISIBLE_SHARE: share,
            }
            if self._parts:
                infos[agent]["reward_parts"] = dict(self._parts)
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
        reward, conflicts = self._play(choices, losers)
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
        """The free agents' actions, illegal ones replaced by 0, and who chose those."""
        choices: dict[int, int] = {}
        illegal: set[int] = set()
        chosen = {i: self._single.as_action(i, actions[a]) for i, a in enumerate(self.agents) if a in actions}
        for i in self.simulator.free_agents(0).tolist():
            agent = self.agents[i]
            if i not in chosen:
                raise IllegalActionError(f"{agent}: is free and has no action")
            if not self._masks[agent][chosen[i]]:
                illegal.add(i)
                chosen[i] = 0
            choices[i] = chosen[i]
        return choices, illegal

    def _losers(self, choices: Mapping[int, int]) -> set[int]:
        """Who chose an action that the draw gives to another."""
        keys, time = self.simulator.episode_keys, self.simulator.time
        best: dict[int, tuple[float, int]] = {}
        for agent, action in choices.items():
            if action > 0:
                bid = (uniforms(keys, time, _CONFLICT, np.array([action]), agent)[0], agent)
                best[action] = min(best.get(action, bid), bid)
        return {agent for agent, action in choices.items() if action > 0 and best[action][1] != agent}

    def _play(self, choices: Mapping[int, int], losers: set[int]) -> tuple[float, set[int]]:
        """Take the epoch's turns in the simulator's order, losers last; the team reward and who met with a conflict.

        Losers come to their actions when those are taken, which is the conflict of the other environment APIs. A turn
        may end the decision epoch for agents that have not had theirs, as the last task of a MuRSE round does; their
        choices lapse.
        """
        reward = 0.0
        conflicts: set[int] = set()
        simulator = self.simulator
        pending = set(choices)
        self._parts = {}
        while pending:
            agent = min((a for a in simulator.free_agents(0).tolist() if a in pending), key=losers.__contains__)
            pending.remove(agent)
            simulator.give_turn(0, agent)
            reward += self._single.step(choices[agent])
            for name, part in self._single.reward_parts().items():
                self._parts[name] = self._parts.get(name, 0.0) + part
            if simulator.conflict[0]:
                conflicts.add(agent)
            if self._single.over or simulator.elapsed[0] > 0:
                break
        return reward, conflicts

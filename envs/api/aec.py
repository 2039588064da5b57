"""PettingZoo AEC: agents take turns. The reference semantics of every domain."""

from __future__ import annotations

from typing import Any

import numpy as np
from pettingzoo import AECEnv

from marl_sched.envs.api.base import SchedulingEnvironment
from marl_sched.errors import IllegalActionError, UnknownNameError
from marl_sched.graph import ACTION_MASK, VISIBLE_SHARE
from marl_sched.simulation import Observation


class SchedulingAEC(SchedulingEnvironment, AECEnv[str, Any, int]):
    """A domain as a PettingZoo AEC environment.

    Only agents with a decision to make are ever selected, `agents` stays the same until all end together, and
    then each is stepped once with None. After a step `rewards` holds for every agent alike the team reward of
    the time that this step let pass: 0 while others still act at this decision epoch, and the last step pays the tail.
    The rewards that one agent reads from `last()` therefore sum to the return.

    An observation is `{"observation": {array name: array}, "action_mask": int8 (max_actions,)}`; its arrays
    are new at every turn. The info of the selected agent holds `action_mask`, `time`, `visible_share` and
    `conflict` (its previous choice was legal in its view and impossible in truth); right after its turn an
    agent's info holds `conflict` alone.

    Args:
        domain: a registered domain or its name.
        options: as SingleEpisode takes them, its `render_mode` included.

    Raises InvalidOptionError for a `scheme`: every free agent has its turn here.
    """

    changing = (
        "agents", "agent_selection", "rewards", "terminations", "truncations", "infos", "_single.position",
        "_cumulative_rewards", "_index", "_conflict", "_skip_agent_selection", "_paid", "_acting", "_seen", "_legal",
    )  # fmt: skip

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start episode 0 of `seed`, or the next episode; `options={"instance": ...}` gives its instance."""
        self._single.reset(seed, options)
        self.agents = self._present()
        self._index = {agent: i for i, agent in enumerate(self.agents)}
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        self._conflict = [False] * len(self.agents)
        self._skip_agent_selection = None
        self._paid = 0.0
        self._next_turn()

    def _next_turn(self) -> None:
        """Select the acting agent and look through its eyes."""
        self._acting = acting = int(self.simulator.acting[0])
        agent = self.agent_selection = self.possible_agents[acting]
        self._seen, self.infos[agent], mask = self._look(acting)
        self._legal = mask.tobytes()

    def _look(self, agent: int) -> tuple[Any, dict[str, Any], np.ndarray]:
        """An agent's observation, info and mask."""
        seen: Observation = self._single.observe(agent)
        mask = seen.pop(ACTION_MASK)
        info = {
            **self.layout.info(mask),
            "conflict": self._conflict[agent],
            "time": int(self.simulator.time[0]),
            VISIBLE_SHARE: float(seen[VISIBLE_SHARE]),
        }
        if parts := self._single.reward_parts():
            info["reward_parts"] = parts
        return self.layout.observation(seen, mask), info, mask

    def observe(self, agent: str) -> Any:
        """What an agent of this instance sees now; one that has no turn may do nothing but action 0."""
        if agent not in self._index:
            raise UnknownNameError("agent", agent, self._index)
        if self._index[agent] == self._acting:
            return self._seen
        return self._look(self._index[agent])[0]

    def step(self, action: Any) -> None:
        """Take the selected agent's turn.

        Raises IllegalActionError for an action outside the space or forbidden by the mask, and after the end;
        the turn is then still to be taken.
        """
        if not self.agents:
            raise IllegalActionError("step: the episode is over, call reset()")
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        acting = self._acting
        action = self._single.as_action(acting, action)
        if not self._legal[action]:
            raise self._single.illegal(acting, action, np.frombuffer(self._legal, np.int8))
        self._cumulative_rewards[agent] = 0.0
        self._pay(self._single.step(action))
        self._conflict[acting] = conflict = bool(self.simulator.conflict[0])
        self.infos[agent] = {"conflict": conflict}
        if self.simulator.acting[0] >= 0:
            self._next_turn()
        else:
            self._end()

    def _pay(self, reward: float) -> None:
        """Give every agent the team reward of the time that passed."""
        if reward != self._paid:
            self.rewards = dict.fromkeys(self.agents, reward)
            self._paid = reward
        if reward != 0.0:
            for agent in self.agents:
                self._cumulative_rewards[agent] += reward

    def _end(self) -> None:
        """End the episode for all agents."""
        self._acting = -1
        self.terminations = dict.fromkeys(self.agents, bool(self.simulator.terminated[0]))
        self.truncations = dict.fromkeys(self.agents, bool(self.simulator.truncated[0]))
        for i, agent in enumerate(self.agents):
            self.infos[agent] = self._look(i)[1]
        self.agent_selection = self.agents[0]

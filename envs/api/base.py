"""What the PettingZoo environments share: one running episode, the agents' spaces, the state and the picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from marl_sched.domain import Domain
from marl_sched.envs.api.episode import SingleEpisode
from marl_sched.envs.api.layout import Layout, MaskPlace
from marl_sched.envs.api.saving import SavesState
from marl_sched.envs.api.spaces import action_space, graph_space
from marl_sched.errors import InvalidOptionError, UnknownNameError


class SchedulingEnvironment(SavesState):
    """The half of a PettingZoo environment that does not ask how agents take turns.

    Args:
        domain: a registered domain or its name.
        flat, mask: how observations and infos are laid out (marl_sched.envs.api.layout); the default is a Dict of
            the graph's arrays with the mask in observation and info.
        pad_agents: whether `agents` are always all possible ones, for tools that need a constant team; those that
            an instance does not have see nothing, can only do nothing and never have a turn.
        options: as SingleEpisode takes them, its `render_mode` included.

    Raises InvalidOptionError for a `scheme`: every free agent has its turn here.
    """

    possible_agents: list[str]
    agents: list[str]

    def __init__(
        self,
        domain: str | Domain,
        *,
        flat: bool = False,
        mask: MaskPlace = "both",
        pad_agents: bool = False,
        **options: Any,
    ) -> None:
        super().__init__()
        if "scheme" in options:
            raise InvalidOptionError(
                "scheme: in AEC and Parallel every free agent decides; schemes are options of Gymnasium and TorchRL"
            )
        self._single = SingleEpisode(domain, **options)
        self.metadata, self.render_mode = self._single.metadata, self._single.render_mode
        simulator = self.simulator = self._single.simulator
        self.possible_agents = [self._single.domain.agent_name(i) for i in range(simulator.max_agents)]
        self.layout, self._pad_agents = Layout(simulator.arrays, flat=flat, mask=mask), pad_agents
        self._observation_spaces = {agent: self.layout.space() for agent in self.possible_agents}
        self._action_spaces = {agent: action_space(simulator) for agent in self.possible_agents}
        self.state_space = graph_space(simulator.arrays)
        self.agents = []

    def __repr__(self) -> str:
        """One line: the class and the problem."""
        return f"{type(self).__name__}({self._single.problem!r})"

    __str__ = __repr__  # PettingZoo's own would tell the class alone

    def _present(self) -> list[str]:
        """The agents of an episode that begins now."""
        return self.possible_agents[: None if self._pad_agents else self.simulator.n_agents[0]]

    def observation_space(self, agent: str) -> spaces.Space:
        """`Dict(observation=Dict(...), action_mask=Box)` or as the layout says, padded to the scale's largest instance.

        Raises UnknownNameError for an agent that is not possible here.
        """
        return self._space_of(agent, self._observation_spaces)

    def action_space(self, agent: str) -> spaces.Space:
        """`Discrete(max_actions)`, padded to the scale's largest instance.

        Raises UnknownNameError for an agent that is not possible here.
        """
        return self._space_of(agent, self._action_spaces)

    def _space_of(self, agent: str, known: dict[str, Any]) -> spaces.Space:
        if agent not in known:
            raise UnknownNameError("agent", agent, known)
        return known[agent]

    def state(self) -> dict[str, np.ndarray]:
        """The full graph, arrays as `state_space` says; after the end no agent acts in it."""
        return self._single.state()

    def render(self) -> Any:
        """The picture of the chosen render mode: str for `ansi`, uint8 (H, W, 3) for `rgb_array`."""
        return self._single.render()

    def close(self) -> None:
        """Nothing is held open."""

"""Gymnasium: one centralised scheduler decides for the whole team, as in the dissertation."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from marl_sched.domain import Domain
from marl_sched.envs.api.episode import SingleEpisode
from marl_sched.envs.api.layout import flattened, vector_space
from marl_sched.envs.api.saving import SavesState
from marl_sched.envs.api.spaces import graph_space
from marl_sched.errors import IllegalActionError, InvalidOptionError
from marl_sched.graph import ACTION_MASK


class SchedulingEnv(SavesState, gymnasium.Env):
    """A domain as a Gymnasium environment with joint actions.

    What a joint action is and which time a step takes is the domain's (`Domain.central`): in AirME an action for
    each crew and an hour. The observation is the whole graph under the full view, with the first agent that has
    to act in the place of the acting one, or agent 0 while all are busy. Illegal parts of an action inside the
    space idle their agents, whom the info lists under `illegal`; the info also holds `time`, and under an
    objective from outside the `reward_parts`.

    Args:
        domain: a registered domain or its name.
        flat: whether observations are float32 vectors (all arrays but the mask, in the order of the simulator's
            `arrays`) and joint actions one-dimensional, as Stable-Baselines3 wants both.
        options: as SingleEpisode takes them, `render_mode` and a domain's `scheme` included, but no `view`.

    Raises InvalidOptionError if a view is given.
    """

    changing = ("_single.position",)

    # An instance variable to type checkers, as gymnasium.Env declares it; `make` reads it from the class.
    metadata: dict[str, Any] = {"render_modes": ["ansi", "rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self, domain: str | Domain, *, render_mode: str | None = None, flat: bool = False, **options: Any
    ) -> None:
        if "view" in options:
            raise InvalidOptionError("view: the centralised environment sees everything; views are for agents")
        self._single = SingleEpisode(domain, render_mode=render_mode, **options)
        self.render_mode = render_mode
        self.simulator = self._single.simulator
        self.central = self._single.domain.central
        self._joint = self.central.action_space(self.simulator)
        self._vector = (
            {name: spec for name, spec in self.simulator.arrays.items() if name != ACTION_MASK} if flat else {}
        )
        self.observation_space: spaces.Space[Any] = graph_space(self.simulator.arrays)
        self.action_space: spaces.Space[Any] = self._joint
        if flat:
            if not isinstance(self._joint, spaces.MultiDiscrete):
                raise InvalidOptionError(f"flat: expected joint actions in a MultiDiscrete, got {self._joint}")
            self.observation_space = vector_space(self._vector)
            self.action_space = spaces.MultiDiscrete(self._joint.nvec.ravel())

    def __repr__(self) -> str:
        """One line: the class and the problem."""
        return f"{type(self).__name__}({self._single.problem!r})"

    __str__ = __repr__  # Gymnasium's own would tell the class alone

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start episode 0 of `seed`, or the next episode; `options={"instance": ...}` gives its instance."""
        super().reset(seed=seed)
        self._single.reset(seed, options)
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play a joint action; its reward is the team's.

        Raises IllegalActionError for an action outside the space and after the end.
        """
        if self._single.over:
            raise IllegalActionError("step: the episode is over, call reset()")
        if not self.action_space.contains(action):
            raise IllegalActionError(f"joint action: expected one in {self.action_space}, got {_shown(action)}")
        reward, info = self.simulator.play_jointly(self.central, np.reshape(action, self._joint.shape))
        terminated, truncated = bool(self.simulator.terminated[0]), bool(self.simulator.truncated[0])
        return self._observe(), reward, terminated, truncated, self._info() | info

    def action_masks(self) -> np.ndarray:
        """Which values each part of a joint action may take, bool (sum of `nvec`,), part after part.

        That is how sb3-contrib's MaskablePPO asks for it. A part whose value clashes with another part's, such as a
        second crew for one plane, idles its agent: no mask of separate parts can exclude it.
        """
        return self.central.action_masks(self.simulator)

    def _observe(self) -> Any:
        graph = self._single.observe(max(int(self.simulator.acting[0]), 0))
        return flattened(graph, self._vector) if self._vector else graph

    def _info(self) -> dict[str, Any]:
        parts = self._single.reward_parts()
        return {"time": int(self.simulator.time[0]), **({"reward_parts": parts} if parts else {})}

    def render(self) -> Any:
        """The picture of the chosen render mode: str for `ansi`, uint8 (H, W, 3) for `rgb_array`."""
        return self._single.render()


def _shown(action: Any) -> str:
    text = np.array2string(np.asarray(action), threshold=20) if np.size(action) else repr(action)
    return text if len(text) <= 120 else text[:117] + "..."

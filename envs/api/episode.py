"""One running episode of a domain: what the PettingZoo and Gymnasium environments share."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any

import numpy as np

from marl_sched.domain import Domain
from marl_sched.envs.api.options import OF_DOMAIN, DefaultScale, as_problem
from marl_sched.errors import IllegalActionError, InvalidOptionError, require
from marl_sched.graph import ACTION_MASK
from marl_sched.noise import Split, as_seed
from marl_sched.problem import as_instance
from marl_sched.simulation import Observation

# PettingZoo's conformance kit passes {"options": 1} to every reset and expects to be heard out.
_KNOWN_OPTIONS = ("instance", "options")


class SingleEpisode:
    """A simulator of one row and the rule by which its episodes follow each other.

    Without a fixed instance episode e of seed s plays instance e of seed s in its split (marl_sched.noise); with
    one, every episode plays it with the noise of episode e. A reset with a seed starts that seed's episode 0, one
    without goes on to the next episode. By default that is the split "train", whose instances and noise
    `marl-sched evaluate` never meets; `split="test"` plays what it plays.

    Args:
        domain: a registered domain or its name.
        scale: of generated instances, and whose largest instance sets the padding; by default the domain's smallest.
            None pads to `instance`.
        instance: a fixed instance or the path of its file.
        view, objective, horizon: see Problem; None is the domain's default.
        seed: of instances and noise until a reset gives another; None draws one from the operating system's entropy.
        split: "train", "validation" or "test".
        render_mode: one of the domain's, or None.
        options: further options of the domain's simulator; unknown ones raise TypeError.

    Attributes:
        problem: what is played, of one instance; its seed is that of the environment's making.
        simulator: the TurnSimulator, with B = 1.
        position: the seed and the number of the running episode, -1 before the first reset.
        metadata: what PettingZoo and Gymnasium ask of a class.
    """

    def __init__(
        self,
        domain: str | Domain,
        *,
        scale: str | DefaultScale | None = OF_DOMAIN,
        instance: Any = None,
        view: Any = None,
        objective: str | None = None,
        horizon: int | None = None,
        seed: int | None = None,
        split: Split = "train",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        self.problem = as_problem(
            domain,
            scale=scale,
            instances=None if instance is None else [instance],
            count=1,
            seed=seed,
            options=options,
            view=view,
            objective=objective,
            horizon=horizon,
            split=split,
        )
        self.domain = self.problem.domain
        if render_mode is not None:
            require(f"render mode of {self.domain.name}", render_mode, self.domain.render)
        self.render_mode = render_mode
        self.metadata = {
            "name": f"{self.domain.name}_v0",
            "render_modes": list(self.domain.render),
            "render_fps": 10,
            "is_parallelizable": False,
        }
        self.position = self.problem.seed, -1
        drawn = {n: v for n, v in self.domain.render_options.get(str(render_mode), {}).items() if n not in options}
        self.simulator = self.problem.simulator(**drawn)
        self._agent = np.zeros(1, np.int64)
        self._action = np.zeros(1, np.int64)
        specs = self.simulator.arrays
        self._layout = [(name, (1, *spec.shape), spec.dtype) for name, spec in specs.items()]

    def reset(self, seed: int | None, options: Mapping[str, Any] | None) -> None:
        """Start the next episode, or episode 0 of `seed`.

        `options={"instance": ...}`, an instance or its file, is played in this episode in place of the usual one.
        Raises UnknownNameError for another option.
        """
        options = options or {}
        for name in options:
            require("reset option", name, _KNOWN_OPTIONS)
        given = as_instance(self.domain, options["instance"]) if "instance" in options else None
        self.position = (as_seed(seed), 0) if seed is not None else (self.position[0], self.position[1] + 1)
        seed, episode = self.position
        instance = self.problem.instance(episode, seed) if given is None else given
        self.simulator.reset(seed=seed, instances=[instance], episodes=self.problem.episode_numbers([episode]))

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return bool(self.simulator.terminated[0] or self.simulator.truncated[0])

    def observe(self, agent: int) -> Observation:
        """The graph that an agent sees now, in fresh arrays without batch axis; after the end it may do nothing.

        An agent that this instance does not have sees nothing and may do nothing.
        """
        simulator = self.simulator
        self._agent[0] = agent if agent < simulator.n_agents[0] else -1
        out = {name: np.empty(shape, dtype) for name, shape, dtype in self._layout}
        simulator.observe(self._agent, out)
        if simulator.acting[0] < 0:
            out[ACTION_MASK][0, 1:] = 0
        return {name: array[0, ...] for name, array in out.items()}

    def state(self) -> Observation:
        """The full graph with the acting agent, without batch axis; after the end no agent acts."""
        return {name: array[0, ...] for name, array in self.simulator.observe_all().items()}

    def step(self, action: int) -> float:
        """Take the acting agent's turn; the team reward of the time that passed."""
        self._action[0] = action
        self.simulator.step(self._action)
        return float(self.simulator.reward[0])

    def reward_parts(self) -> dict[str, float]:
        """The parts of the reward of the last step, as an objective from outside names them; mostly none."""
        return {name: float(values[0]) for name, values in self.simulator.reward_parts.items()}

    def as_action(self, agent: int, action: Any) -> int:
        """A given action as an integer in [0, max_actions), legal or not; IllegalActionError outside the space."""
        try:
            action = operator.index(action)
        except TypeError as error:
            raise IllegalActionError(f"{self._name(agent)}: expected an integer action, got {action!r}") from error
        if not 0 <= action < self.simulator.max_actions:
            highest = self.simulator.max_actions - 1
            raise IllegalActionError(f"{self._name(agent)}: action {action}: expected one in [0, {highest}]")
        return action

    def illegal(self, agent: int, action: int, mask: np.ndarray) -> IllegalActionError:
        """The error for an action that an agent's mask, int8 (max_actions,), forbids."""
        legal = ", ".join(map(str, np.flatnonzero(mask)))
        time = self.simulator.time[0]
        return IllegalActionError(f"{self._name(agent)}: action {action} is not legal at time {time}; legal: {legal}")

    def _name(self, agent: int) -> str:
        return self.domain.agent_name(agent)

    def render(self) -> Any:
        """The picture of the chosen render mode; InvalidOptionError if none was chosen."""
        if self.render_mode is None:
            known = ", ".join(self.domain.render)
            raise InvalidOptionError(f"render: the environment was made without render_mode; known: {known}")
        return self.domain.render[self.render_mode](self.simulator, 0)

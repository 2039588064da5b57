"""Objectives from outside a domain: what an episode is scored by, and what its reward follows.

    class Strain:                                   # waiting jobs and places travelled at once
        parts = ("waiting", "travel")

        def start(self, simulator, rows): ...
        def total(self, simulator): ...             # float64 (B, 2), from the start of each env's episode

It is named as `package.module:factory` wherever an objective is (`--objective couriers.objectives:Strain`), or by an
entry point `<domain>.<name>` of the group `marl_sched.objectives`. A higher total is a higher reward; the score (M1) is
the size of the total per unit of the episode, as the domain's own scores are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from marl_sched.errors import InvalidOptionError
from marl_sched.plugins import OBJECTIVES, import_object, is_object_name, load_offered, offered
from marl_sched.simulation import Observation, TurnSimulator

if TYPE_CHECKING:
    from marl_sched.domain import Domain
    from marl_sched.domain_parts import CentralInterface


class Objective(Protocol):
    """A measure of an episode that grows, or falls, as it is played.

    Attributes:
        parts: names of the parts that it is the sum of; one name where there is nothing to tell apart.
    """

    parts: tuple[str, ...]

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Called after `envs`, bool (B,), began a new episode."""

    def total(self, simulator: TurnSimulator) -> np.ndarray:
        """The reward of each env's episode so far, part by part, float64 (B, len(parts))."""


def objective_names(domain: str) -> list[str]:
    """Names of the objectives that other distributions offer for a domain, sorted; nothing is imported."""
    return sorted(name.partition(".")[2] for name in offered(OBJECTIVES) if name.partition(".")[0] == domain)


def outside_objective(domain: Domain, name: str) -> Objective | None:
    """The objective of that name from outside the domain, made anew; None for one of the domain's own.

    Raises InvalidOptionError for a `package.module:factory` that does not lead to an objective.
    """
    if name in domain.objectives:
        return None
    if is_object_name(name):
        made = import_object(name)()
    elif f"{domain.name}.{name}" in offered(OBJECTIVES):
        made = load_offered(offered(OBJECTIVES)[f"{domain.name}.{name}"])()
    else:
        return None
    if not all(hasattr(made, part) for part in ("parts", "start", "total")):
        raise InvalidOptionError(f"objective {name}: expected parts, start() and total(), got {type(made).__name__}")
    return made


class ScoredSimulator(TurnSimulator):
    """A domain's simulator whose reward and score are those of an objective from outside.

    `rewards` float64 (B, K) are the parts of `reward`. Everything else is the domain's simulator, `inner`.
    """

    def __init__(self, inner: TurnSimulator, name: str, objective: Objective) -> None:
        self.inner, self._name, self._objective = inner, name, objective
        self.reward = np.zeros(inner.batch)
        self.rewards = np.zeros((inner.batch, len(objective.parts)))
        self._paid = np.zeros_like(self.rewards)  # the totals up to now
        self._begin(np.ones(inner.batch, np.bool_))

    def __getattr__(self, name: str) -> Any:
        """Attributes of the domain's simulator; a joint step of its own would leave the reward behind."""
        if name.startswith(("__", "play_")) or name == "inner":
            raise AttributeError(f"{name}: expected step() or play_jointly(), which pay an objective from outside")
        return getattr(self.inner, name)

    def _begin(self, envs: np.ndarray) -> None:
        self._objective.start(self.inner, envs)
        self.reward[envs] = self.rewards[envs] = 0.0
        self._paid = np.where(envs[:, None], self._objective.total(self.inner), self._paid)

    def reset(
        self,
        envs: np.ndarray | None = None,
        *,
        seed: int | None = None,
        instances: Sequence[Any] | None = None,
        episodes: Sequence[int] | None = None,
    ) -> None:
        """Start new episodes; see TurnSimulator.reset."""
        self.inner.reset(envs, seed=seed, instances=instances, episodes=episodes)
        self._begin(np.ones(self.inner.batch, np.bool_) if envs is None else np.asarray(envs, np.bool_))

    def step(self, actions: np.ndarray) -> None:
        """Take one turn in every env, and pay what the objective grew by."""
        self.inner.step(actions)
        self._pay()

    def play_jointly(self, central: CentralInterface, action: Any) -> tuple[float, dict[str, Any]]:
        """Play a joint action of env 0 on the domain's simulator, and pay what the objective grew by."""
        _, infos = central.play(self.inner, action)
        self._pay()
        return float(self.reward[0]), infos

    def _pay(self) -> None:
        total = self._objective.total(self.inner)
        self.rewards[:] = total - self._paid
        self.reward[:] = self.rewards.sum(axis=1)
        self._paid = total

    def observe(self, agents: np.ndarray, out: Observation | None = None) -> Observation:
        """What the domain's simulator shows."""
        return self.inner.observe(agents, out)

    def observe_all(self) -> Observation:
        """What the domain's simulator shows under the full view."""
        return self.inner.observe_all()

    def free_agents(self, env_index: int) -> np.ndarray:
        """As the domain's simulator."""
        return self.inner.free_agents(env_index)

    def objectives(self) -> dict[str, np.ndarray]:
        """The domain's measures, then the objective's, per unit of the episode; one for each of several parts."""
        share = np.abs(self._paid) / np.maximum(self.inner.progress, 1)[:, None]
        parts = {f"{self._name}/{part}": share[:, k] for k, part in enumerate(self._objective.parts)}
        whole = np.abs(self._paid.sum(axis=1)) / np.maximum(self.inner.progress, 1)
        return {**self.inner.objectives(), self._name: whole, **(parts if len(parts) > 1 else {})}

    def per_round(self) -> dict[str, np.ndarray]:
        """As the domain's simulator."""
        return self.inner.per_round()

    def agent_figures(self) -> dict[str, np.ndarray]:
        """As the domain's simulator."""
        return self.inner.agent_figures()

    def snapshot(self, env_index: int) -> dict[str, np.ndarray]:
        """The domain's state, and what was paid."""
        return {
            **self.inner.snapshot(env_index),
            "paid": self._paid[env_index].copy(),
            "reward_paid": self.reward[env_index].copy(),
        }

    @property
    def reward_parts(self) -> Mapping[str, np.ndarray]:
        """The objective's parts of the last step's reward."""
        return {part: self.rewards[:, k] for k, part in enumerate(self._objective.parts)}

    @property
    def length(self) -> np.ndarray:
        """As the domain's simulator."""
        return self.inner.length

    @property
    def progress(self) -> np.ndarray:
        """As the domain's simulator."""
        return self.inner.progress

    @property
    def presence(self) -> Mapping[str, np.ndarray]:
        """As the domain's simulator."""
        return self.inner.presence

    @property
    def availability(self) -> Mapping[str, np.ndarray]:
        """As the domain's simulator."""
        return self.inner.availability

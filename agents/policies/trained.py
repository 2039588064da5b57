"""What all trained policies share, whatever runs their networks: NumPy arrays in, actions out."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, TypedDict, Unpack, get_args

import numpy as np

from marl_sched.agents.base import ObservationScheduler, Scheduler, Worths, inverse_distribution
from marl_sched.agents.policies.cards import Mode, PolicyCard, check_graph
from marl_sched.domain import domain_names, get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK, STATE, TIME, VISIBLE_SHARE, GraphSpec

if TYPE_CHECKING:
    from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]
Pressing = Callable[[GraphSpec, Observation], np.ndarray]  # see Domain.pressing
_NEVER = -1  # before every simulated time


class PolicyOptions(TypedDict, total=False):
    """Options of a policy; see TrainedPolicy."""

    name: str
    mode: Mode
    card: PolicyCard | None
    domain: str | None
    pressing: Pressing | None


class _FirstLogits(NamedTuple):
    """Of every row of a batch, the simulated time, int64 (B,), of the decision epoch whose first logits are kept."""

    time: np.ndarray
    logits: np.ndarray  # float32 (B, n_actions)


class TrainedPolicy(Scheduler):
    """A network that decides, whatever its architecture and whatever runs it.

    At batch size 1 a choice is a function of the observation's bits, the padding included; in a larger batch
    logits agree within 1e-5, as the network then sees it in blocks without what nobody sees
    (marl_sched.agents.networks.batches).

    Args:
        graph: the metagraph that the network reads.
        name: as users type it.
        mode: `greedy` takes the most probable action, ties to the lowest index, and never does nothing while an
            action is pressing (see Domain.pressing); `sample` picks by inverse
            distribution with the uniform that it is given. `one_pass` samples for all agents of a decision epoch from
            what the first of them saw, without the actions that are taken by then: how the dissertation plays what was
            trained with one decision an hour (scheme Single, section 6.3.1). On a lone observation it samples.
        card: what the weights are, if they come from a file.
        domain: the domain's name, whose pressing actions count; None: the card's. Without either none is pressing.
        pressing: what tells pressing actions, if the domain is not to be imported for it.

    Raises InvalidOptionError for another mode.
    """

    def __init__(
        self,
        graph: GraphSpec,
        *,
        name: str = "unsaved",
        mode: Mode = "greedy",
        card: PolicyCard | None = None,
        domain: str | None = None,
        pressing: Pressing | None = None,
    ) -> None:
        if mode not in get_args(Mode):
            raise InvalidOptionError(
                f"mode of policy {name}: expected one of {', '.join(get_args(Mode))}, got {mode!r}"
            )
        self.name, self.mode, self.card, self.graph = name, mode, card, graph
        self._domain = card.domain if domain is None and card is not None else domain
        self._given_pressing = pressing
        self.samples = mode != "greedy"
        self._arrays = arrays_read(graph)
        self._n_features = {node.name: len(node.features) for node in self.graph.nodes}
        self._n_features[STATE] = len(self.graph.state_features)
        self._checked: GraphSpec | None = None

    @cached_property
    def _pressing(self) -> Pressing | None:
        """What its domain says must not wait; None without a domain or for one that is not there."""
        if self._given_pressing is not None:
            return self._given_pressing
        if self._domain is None or self._domain not in domain_names():
            return None
        return get_domain(self._domain).pressing

    def _check(self, simulator: TurnSimulator) -> None:
        """Raise InvalidFileError if the policy was trained on another metagraph than the simulator's."""
        if simulator.graph is not self._checked:
            if self.card is not None:
                check_graph(f"{self.name}.json", self.card, simulator.graph)
            self._checked = simulator.graph

    def _pick(self, logits: np.ndarray, uniform: np.ndarray, observation: Observation) -> np.ndarray:
        if self.samples:
            return inverse_distribution(logits, uniform)
        actions = logits.argmax(1)
        if self._pressing is None or actions.all():
            return actions
        urgent = np.where(self._pressing(self.graph, observation), logits, -np.inf)
        return np.where((actions == 0) & (urgent.max(1) > -np.inf), urgent.argmax(1), actions)

    def _read(self, observation: Observation) -> dict[str, np.ndarray]:
        """The arrays that the network reads; InvalidOptionError where they are not those that it was trained on."""
        for name, n_features in self._n_features.items():
            shape = np.shape(observation[name]) if name in observation else ()
            if not shape or shape[-1] != n_features:
                raise InvalidOptionError(
                    f"observation: {name}: policy {self.name} expects {n_features} features, got shape {shape}"
                )
        return {name: observation[name] for name in self._arrays}


class LogitsPolicy(TrainedPolicy, ObservationScheduler):
    """Decides by a network that carries no memory; see TrainedPolicy."""

    def __init__(self, graph: GraphSpec, **options: Unpack[PolicyOptions]) -> None:
        super().__init__(graph, **options)
        self._first = _FirstLogits(np.zeros(0, np.int64), np.zeros((0, 0), np.float32))

    @abstractmethod
    def logits(self, observation: Observation) -> np.ndarray:
        """Logits float32 (B, n_actions) of batched observations; the lowest finite number where illegal.

        Raises InvalidOptionError for an observation without the arrays or the features that it was trained on.
        """

    def start(self, simulator: TurnSimulator, envs: np.ndarray) -> None:
        """Forget what was seen in earlier episodes of these rows."""
        if self._first.time.shape == envs.shape:
            self._first.time[envs] = _NEVER

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Observe for every acting agent under the simulator's view, then choose.

        Raises InvalidFileError if the policy was trained on another metagraph than the simulator's, InvalidOptionError
        for the mode one_pass under a view that hides something.
        """
        self._check(simulator)
        rows, observation = simulator.observe_acting()
        actions = np.zeros(simulator.batch, np.int64)
        if len(rows):
            one_pass = self.mode == "one_pass"
            logits = self._of_epoch(simulator, rows, observation) if one_pass else self.logits(observation)
            noise = simulator.policy_noise(simulator.acting)[rows] if self.samples else np.zeros(len(rows))
            actions[rows] = self._pick(logits, noise, observation)
        return actions

    def _of_epoch(self, simulator: TurnSimulator, envs: np.ndarray, observation: Observation) -> np.ndarray:
        """The logits of the first turn of each row's decision epoch, for the actions that are still legal."""
        if simulator.view.hides:
            raise InvalidOptionError(
                f"mode of policy {self.name}: one_pass shares what the first agent sees, so it is for the full view; "
                f"got view {simulator.view.kind}"
            )
        legal = observation[ACTION_MASK] != 0
        if self._first.logits.shape != (simulator.batch, legal.shape[1]):
            never = np.full(simulator.batch, _NEVER)
            self._first = _FirstLogits(never, np.zeros((simulator.batch, legal.shape[1]), np.float32))
        new = self._first.time[envs] != simulator.time[envs]
        if new.any():
            self._first.logits[envs[new]] = self.logits({name: values[new] for name, values in observation.items()})
            self._first.time[envs] = simulator.time[envs]
        return np.where(legal, self._first.logits[envs], np.finfo(np.float32).min)

    def worths(self, simulator: TurnSimulator) -> Worths:
        """The probabilities with which it would take each action if it sampled."""
        observation = simulator.observe(simulator.acting)
        logits = self.logits(observation).astype(np.float64)
        weights = np.exp(logits - logits.max(axis=1, keepdims=True))
        shares = 100.0 * weights / weights.sum(axis=1, keepdims=True)
        return Worths(np.where(observation[ACTION_MASK] > 0, shares, -np.inf), f"percent that {self.name} gives it")

    def choose(self, observation: Observation, uniform: np.ndarray) -> np.ndarray:
        """Actions int64 (B,) from batched observations and uniforms float64 (B,) in [0, 1)."""
        return self._pick(self.logits(observation), uniform, observation)


def arrays_read(graph: GraphSpec) -> list[str]:
    """The names of the arrays of an observation that a network of this metagraph may read, in a fixed order."""
    sizes = {node.name: 1 for node in graph.nodes}
    return [array for array in graph.arrays(sizes) if array not in (TIME, VISIBLE_SHARE)]

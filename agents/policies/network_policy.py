"""A trained network as a scheduler: NumPy arrays in, actions out."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack, cast, get_args

import numpy as np
import torch
from torch import Tensor

from marl_sched.agents.base import ObservationScheduler, Scheduler, Worths, inverse_distribution
from marl_sched.agents.networks.batches import logits_in_blocks, recurred_in_blocks
from marl_sched.agents.networks.network import PolicyNetwork, RecurrentNetwork
from marl_sched.agents.networks.planner import PlannerNetwork, TrainedPlanner
from marl_sched.agents.policies.cards import Mode, PolicyCard, check_graph
from marl_sched.agents.policies.checkpoint import load_network
from marl_sched.agents.recurrent import RecurrentScheduler
from marl_sched.domain import domain_names, get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK, STATE, TIME, VISIBLE_SHARE, GraphSpec
from marl_sched.simulation import TurnSimulator

Observation = Mapping[str, np.ndarray]
_NEVER = -1  # before every simulated time


class PolicyOptions(TypedDict, total=False):
    """Options of a policy that is made from a network; see TrainedPolicy."""

    name: str
    mode: Mode
    card: PolicyCard | None
    domain: str | None


class _FirstLogits(NamedTuple):
    """Of every row of a batch, the simulated time, int64 (B,), of the decision epoch whose first logits are kept."""

    time: np.ndarray
    logits: np.ndarray  # float32 (B, n_actions)


class TrainedPolicy(Scheduler):
    """A copy of a network that decides, whatever its architecture; `policy_of` makes the one that a network needs.

    At batch size 1 a choice is a function of the observation's bits, the padding included; in a larger batch
    logits agree within 1e-5, as the network then sees it in blocks without what nobody sees
    (marl_sched.agents.networks.batches).

    Args:
        network: on any device; the copy is on the CPU.
        name: as users type it.
        mode: `greedy` takes the most probable action, ties to the lowest index, and never does nothing while an
            action is pressing (see Domain.pressing); `sample` picks by inverse
            distribution with the uniform that it is given. `one_pass` samples for all agents of a decision epoch from
            what the first of them saw, without the actions that are taken by then: how the dissertation plays what was
            trained with one decision an hour (scheme Single, section 6.3.1). On a lone observation it samples.
        card: what the weights are, if they come from a file.
        domain: the domain's name, whose pressing actions count; None: the card's. Without either none is pressing.

    Raises InvalidOptionError for another mode.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        *,
        name: str = "unsaved",
        mode: Mode = "greedy",
        card: PolicyCard | None = None,
        domain: str | None = None,
    ) -> None:
        if mode not in get_args(Mode):
            raise InvalidOptionError(
                f"mode of policy {name}: expected one of {', '.join(get_args(Mode))}, got {mode!r}"
            )
        self.name, self.mode, self.card = name, mode, card
        self._domain = card.domain if domain is None and card is not None else domain
        self.samples = mode != "greedy"
        self.graph: GraphSpec = network.spec
        self._network = copy.deepcopy(network).cpu().requires_grad_(False)
        with torch.inference_mode():
            self._weights = self._network.weights()
        sizes = {node.name: 1 for node in self.graph.nodes}
        self._arrays = [array for array in self.graph.arrays(sizes) if array not in (TIME, VISIBLE_SHARE)]
        self._n_features = {node.name: len(node.features) for node in self.graph.nodes}
        self._n_features[STATE] = len(self.graph.state_features)
        self._checked: GraphSpec | None = None

    @cached_property
    def _pressing(self) -> Callable[[GraphSpec, Observation], np.ndarray] | None:
        """What its domain says must not wait; None without a domain or for one that is not there."""
        if self._domain is None or self._domain not in domain_names():
            return None
        return get_domain(self._domain).pressing

    @staticmethod
    def load(
        path: str | Path, *, mode: Mode | None = None, graph: GraphSpec | None = None, **options: Any
    ) -> NetworkPolicy | RecurrentPolicy | TrainedPlanner:
        """A policy from its files (marl_sched.agents.policies.checkpoint); its name is the file's.

        `mode` None is its card's, `options` are a planner's. Raises InvalidFileError for damaged files, or if the
        policy was trained on another metagraph than `graph`, TypeError for options that it does not have.
        """
        network, card = load_network(path)
        if graph is not None:
            check_graph(Path(path).with_suffix(".json"), card, graph)
        mode = card.mode if mode is None else mode
        return policy_of(network, name=Path(path).stem, mode=mode, card=card, **options)

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

    def _tensors(self, observation: Observation) -> dict[str, Tensor]:
        """The arrays that the network reads; InvalidOptionError where they are not those that it was trained on."""
        for name, n_features in self._n_features.items():
            shape = np.shape(observation[name]) if name in observation else ()
            if not shape or shape[-1] != n_features:
                raise InvalidOptionError(
                    f"observation: {name}: policy {self.name} expects {n_features} features, got shape {shape}"
                )
        return {name: _tensor(observation[name]) for name in self._arrays}


class NetworkPolicy(TrainedPolicy, ObservationScheduler):
    """Decides by a network that carries no memory; see TrainedPolicy."""

    def __init__(self, network: PolicyNetwork, **options: Unpack[PolicyOptions]) -> None:
        if isinstance(network, RecurrentNetwork):
            raise InvalidOptionError(f"policy {options.get('name', '')}: expected RecurrentPolicy for its network")
        super().__init__(network, **options)
        self._first = _FirstLogits(np.zeros(0, np.int64), np.zeros((0, 0), np.float32))

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

    @torch.inference_mode()
    def logits(self, observation: Observation) -> np.ndarray:
        """Logits float32 (B, n_actions) of batched observations; the lowest finite number where illegal.

        Raises InvalidOptionError for an observation without the arrays or the features that it was trained on.
        """
        tensors = self._tensors(observation)
        if len(tensors[ACTION_MASK]) == 1:
            return self._network(tensors, self._weights).numpy()
        return logits_in_blocks(self._network, tensors, self._weights).numpy()


class RecurrentPolicy(TrainedPolicy, RecurrentScheduler):
    """Decides by a network with which every agent carries a memory; see TrainedPolicy and RecurrentScheduler.

    Raises InvalidOptionError for a network without a memory, and for the mode one_pass: what the first agent of an
    epoch sees does not go into the memories of the others.
    """

    def __init__(self, network: PolicyNetwork, **options: Unpack[PolicyOptions]) -> None:
        super().__init__(network, **options)
        if not isinstance(network, RecurrentNetwork):
            raise InvalidOptionError(f"policy {self.name}: expected a recurrent network, got {type(network).__name__}")
        self._recurrent = cast(RecurrentNetwork, self._network)
        if self.mode == "one_pass":
            raise InvalidOptionError(f"mode of policy {self.name}: expected greedy or sample, as it has a memory")
        self.memory_size = network.memory_size

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """See RecurrentScheduler; raises InvalidFileError for a simulator of another metagraph."""
        self._check(simulator)
        return super().decide(simulator)

    def choose_recurrent(
        self, observation: Observation, memory: np.ndarray, uniform: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions int64 (B,) and new memories float32 (B, memory_size); see RecurrentScheduler."""
        logits, after = self.recur(observation, memory)
        return self._pick(logits, uniform, observation), after

    @torch.inference_mode()
    def recur(self, observation: Observation, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Logits float32 (B, n_actions) and new memories float32 (B, memory_size); raises as NetworkPolicy.logits."""
        tensors, before = self._tensors(observation), _tensor(memory)
        if len(before) == 1:
            logits, after = self._recurrent.recur(tensors, before)
        else:
            logits, after = recurred_in_blocks(self._recurrent, tensors, before)
        return logits.numpy(), after.numpy()


def policy_of(
    network: PolicyNetwork,
    *,
    name: str = "unsaved",
    mode: Mode = "greedy",
    card: PolicyCard | None = None,
    domain: str | None = None,
    **options: Any,
) -> NetworkPolicy | RecurrentPolicy | TrainedPlanner:
    """The policy that decides by a network, with a memory where the network has one; options as TrainedPolicy's.

    A planner's network makes its own scheduler, from its further `options`. It plans greedily: InvalidOptionError for
    another mode. Raises TypeError for options of a network that plans nothing.
    """
    if isinstance(network, PlannerNetwork):
        if mode != "greedy":
            raise InvalidOptionError(f"mode of policy {name}: expected greedy, as it plans whole rounds, got {mode!r}")
        return network.planner(name, card, **options)
    if options:
        raise TypeError(f"policy {name}: unknown options {', '.join(sorted(options))}")
    kind = RecurrentPolicy if isinstance(network, RecurrentNetwork) else NetworkPolicy
    return kind(network, name=name, mode=mode, card=card, domain=domain)


def _tensor(array: np.ndarray) -> Tensor:
    """A tensor on the array's memory; arrays from a message are read-only, which PyTorch has no notion of."""
    return torch.from_numpy(array if array.flags.writeable else array.copy())

"""A trained network as a scheduler that PyTorch runs: NumPy arrays in, actions out."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np
import torch
from torch import Tensor

from marl_sched.agents.networks.batches import logits_in_blocks, recurred_in_blocks
from marl_sched.agents.networks.network import PolicyNetwork, RecurrentNetwork
from marl_sched.agents.networks.planner import PlannerNetwork, TrainedPlanner
from marl_sched.agents.policies.cards import Mode, PolicyCard, check_graph
from marl_sched.agents.policies.checkpoint import load_network
from marl_sched.agents.policies.trained import LogitsPolicy, Observation, PolicyOptions, TrainedPolicy
from marl_sched.agents.recurrent import RecurrentScheduler
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK, GraphSpec
from marl_sched.simulation import TurnSimulator


class _TorchPolicy(TrainedPolicy):
    """A copy, on the CPU, of a network that may be on any device; `policy_of` makes the one that a network needs."""

    def __init__(self, network: PolicyNetwork, **options: Unpack[PolicyOptions]) -> None:
        super().__init__(network.spec, **options)
        self._network = copy.deepcopy(network).cpu().requires_grad_(False)
        with torch.inference_mode():
            self._weights = self._network.weights()

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

    def _tensors(self, observation: Observation) -> dict[str, Tensor]:
        return {name: _tensor(values) for name, values in self._read(observation).items()}


class NetworkPolicy(_TorchPolicy, LogitsPolicy):
    """Decides by a network that carries no memory; see TrainedPolicy."""

    def __init__(self, network: PolicyNetwork, **options: Unpack[PolicyOptions]) -> None:
        if isinstance(network, RecurrentNetwork):
            raise InvalidOptionError(f"policy {options.get('name', '')}: expected RecurrentPolicy for its network")
        super().__init__(network, **options)

    @torch.inference_mode()
    def logits(self, observation: Observation) -> np.ndarray:
        """See LogitsPolicy.logits."""
        tensors = self._tensors(observation)
        if len(tensors[ACTION_MASK]) == 1:
            return self._network(tensors, self._weights).numpy()
        return logits_in_blocks(self._network, tensors, self._weights).numpy()


class RecurrentPolicy(_TorchPolicy, RecurrentScheduler):
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
        """Logits float32 (B, n_actions) and new memories float32 (B, memory_size); raises as LogitsPolicy.logits."""
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

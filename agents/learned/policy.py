"""A trained network as a scheduler: NumPy arrays in, targets out."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from marl_sched.agents.base import ObservationScheduler
from marl_sched.agents.cards import Mode, PolicyCard, check_graph
from marl_sched.agents.learned.batches import logits_in_blocks
from marl_sched.agents.learned.checkpoint import load_network
from marl_sched.agents.learned.network import PolicyNetwork
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK, STATE, TIME, VISIBLE_SHARE, GraphSpec
from marl_sched.simulation import TurnSimulator


class NetworkPolicy(ObservationScheduler):
    """Decides by a copy of a network, whatever its architecture.

    At batch size 1 a choice is a function of the observation's bits, the padding included; in a larger batch
    logits agree within 1e-5, as the network then sees it in blocks without what nobody sees
    (marl_sched.agents.learned.batches).

    Args:
        network: on any device; the copy is on the CPU.
        name: as users type it.
        mode: `greedy` takes the most probable target, ties to the lowest index; `sample` picks by inverse
            distribution with the uniform that it is given.
        card: what the weights are, if they come from a file.
    """

    def __init__(
        self, network: PolicyNetwork, *, name: str = "unsaved", mode: Mode = "greedy", card: PolicyCard | None = None
    ) -> None:
        if mode not in get_args(Mode):
            raise InvalidOptionError(
                f"mode of policy {name}: expected one of {', '.join(get_args(Mode))}, got {mode!r}"
            )
        self.name, self.mode, self.card = name, mode, card
        self.samples = mode == "sample"
        self.graph: GraphSpec = network.spec
        self._network = copy.deepcopy(network).cpu().requires_grad_(False)
        with torch.inference_mode():
            self._weights = self._network.weights()
        sizes = {node.name: 1 for node in self.graph.nodes}
        self._arrays = [array for array in self.graph.arrays(sizes) if array not in (TIME, VISIBLE_SHARE)]
        self._n_features = {node.name: len(node.features) for node in self.graph.nodes}
        self._n_features[STATE] = len(self.graph.state_features)
        self._checked: GraphSpec | None = None

    @classmethod
    def load(cls, path: str | Path, *, mode: Mode | None = None, graph: GraphSpec | None = None) -> NetworkPolicy:
        """A policy from its files (marl_sched.agents.learned.checkpoint); its name is the file's.

        `mode` None is its card's. Raises InvalidFileError for damaged files, or if the policy was trained on
        another metagraph than `graph`.
        """
        network, card = load_network(path)
        if graph is not None:
            check_graph(Path(path).with_suffix(".json"), card, graph)
        return cls(network, name=Path(path).stem, mode=card.mode if mode is None else mode, card=card)

    def decide(self, simulator: TurnSimulator) -> np.ndarray:
        """Observe for every acting agent under the simulator's view, then choose.

        Raises InvalidFileError if the policy was trained on another metagraph than the simulator's.
        """
        if simulator.graph is not self._checked:
            if self.card is not None:
                check_graph(f"{self.name}.json", self.card, simulator.graph)
            self._checked = simulator.graph
        agents = simulator.acting
        acting = agents >= 0
        if acting.all():
            return super().decide(simulator)
        # Rows that are over would cost as much as the others: episodes of a batch end at different turns.
        targets = np.zeros(simulator.batch, np.int64)
        if acting.any():
            observation = {name: values[acting] for name, values in simulator.observe(agents).items()}
            targets[acting] = self.choose(observation, simulator.policy_noise(agents)[acting])
        return targets

    def choose(self, observation: Mapping[str, np.ndarray], uniform: np.ndarray) -> np.ndarray:
        """Targets int64 (B,) from batched observations and uniforms float64 (B,) in [0, 1)."""
        logits = self.logits(observation)
        return logits.argmax(1) if self.mode == "greedy" else inverse_distribution(logits, uniform)

    @torch.inference_mode()
    def logits(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Logits float32 (B, n_targets) of batched observations; the lowest finite number where illegal.

        Raises InvalidOptionError for an observation without the arrays or the features that it was trained on.
        """
        for name, n_features in self._n_features.items():
            shape = np.shape(observation[name]) if name in observation else ()
            if not shape or shape[-1] != n_features:
                raise InvalidOptionError(
                    f"observation: {name}: policy {self.name} expects {n_features} features, got shape {shape}"
                )
        tensors = {name: _tensor(observation[name]) for name in self._arrays}
        if len(tensors[ACTION_MASK]) == 1:
            return self._network(tensors, self._weights).numpy()
        return logits_in_blocks(self._network, tensors, self._weights).numpy()


def inverse_distribution(logits: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """For each row the first target whose cumulated probability exceeds the row's uniform.

    logits (B, n_targets), with at least one that is not the lowest finite number; uniform float64 (B,) in
    [0, 1); returns int64 (B,). Targets of probability zero are never picked.
    """
    weights = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
    cumulated = weights.cumsum(axis=1)
    # A uniform next to 1 may round up to the total; the largest number below the total still has a target.
    level = np.minimum(uniform * cumulated[:, -1], np.nextafter(cumulated[:, -1], 0.0))
    return (cumulated > level[:, None]).argmax(axis=1)


def _tensor(array: np.ndarray) -> Tensor:
    """A tensor on the array's memory; arrays from a message are read-only, which PyTorch has no notion of."""
    return torch.from_numpy(array if array.flags.writeable else array.copy())

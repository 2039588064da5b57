"""Gymnasium spaces of a simulator's observations, actions and state."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from gymnasium import spaces

from marl_sched.graph import ArraySpec
from marl_sched.simulation import TurnSimulator


def array_space(spec: ArraySpec) -> spaces.Box:
    """The Box of one array. Features are finite, so the bounds of an unbounded one are the largest floats."""
    low, high = spec.low, spec.high
    if np.issubdtype(spec.dtype, np.floating):
        largest = np.finfo(spec.dtype).max
        low, high = max(low, -largest), min(high, largest)
    return spaces.Box(low, high, spec.shape, spec.dtype.type)


def graph_space(arrays: Mapping[str, ArraySpec]) -> spaces.Dict:
    """The Dict of all arrays of a graph, the action mask among them."""
    return spaces.Dict({name: array_space(spec) for name, spec in arrays.items()})


def action_space(simulator: TurnSimulator) -> spaces.Discrete:
    """`Discrete(max_actions)`: an action is a node's global index, 0 does nothing."""
    return spaces.Discrete(simulator.max_actions)

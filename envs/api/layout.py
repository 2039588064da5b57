"""How an environment hands out an agent's observation: as the graph's arrays or one vector, and where the mask is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from marl_sched.envs.api.spaces import array_space, graph_space
from marl_sched.errors import require
from marl_sched.graph import ACTION_MASK, ArraySpec
from marl_sched.simulation import Observation

MaskPlace = Literal["both", "observation", "info"]
MASK_PLACES = ("both", "observation", "info")
OBSERVATION = "observation"


class Layout:
    """The layout of an environment's observations and infos.

    | `flat` | `mask` | observation |
    |---|---|---|
    | False | both, observation | `{"observation": {name: array}, "action_mask": int8 (max_actions,)}` |
    | False | info | `{name: array}` |
    | True | both, observation | `{"observation": float32 (n,), "action_mask": int8 (max_actions,)}` |
    | True | info | float32 (n,) |

    A flat vector holds all arrays but the mask, in the order of the simulator's `arrays`, each in C order.

    Args:
        arrays: of the simulator, the action mask among them.
        flat: whether observations are vectors.
        mask: where the action mask is: in the observation, in the info, or in both.

    Raises UnknownNameError for another place of the mask.
    """

    def __init__(self, arrays: Mapping[str, ArraySpec], *, flat: bool, mask: MaskPlace) -> None:
        self.flat, self.mask = flat, require("place of the mask", mask, MASK_PLACES)
        self._arrays = {name: spec for name, spec in arrays.items() if name != ACTION_MASK}
        self._mask_space = array_space(arrays[ACTION_MASK])

    def space(self) -> spaces.Space:
        """The space of an agent's observation."""
        seen = vector_space(self._arrays) if self.flat else graph_space(self._arrays)
        return seen if self.mask == "info" else spaces.Dict({OBSERVATION: seen, ACTION_MASK: self._mask_space})

    def observation(self, graph: Observation, mask: np.ndarray) -> Any:
        """An agent's observation from its graph without the mask, and its mask."""
        seen = flattened(graph, self._arrays) if self.flat else graph
        return seen if self.mask == "info" else {OBSERVATION: seen, ACTION_MASK: mask}

    def info(self, mask: np.ndarray) -> dict[str, np.ndarray]:
        """What of the mask goes into the agent's info."""
        return {} if self.mask == "observation" else {ACTION_MASK: mask}


def vector_space(arrays: Mapping[str, ArraySpec]) -> spaces.Box:
    """The space of these arrays as one float32 vector."""
    largest = np.finfo(np.float32).max
    bounds = [(max(s.low, -largest), min(s.high, largest), int(np.prod(s.shape))) for s in arrays.values()]
    low, high = (np.concatenate([np.full(b[2], b[side], np.float32) for b in bounds]) for side in (0, 1))
    return spaces.Box(low, high, dtype=np.float32)


def flattened(graph: Mapping[str, np.ndarray], arrays: Mapping[str, ArraySpec]) -> np.ndarray:
    """The arrays of an observation as one float32 vector, in the order of `arrays`."""
    return np.concatenate([graph[name].ravel() for name in arrays], dtype=np.float32, casting="unsafe")

"""Writes a trained policy as ONNX, by which onnxruntime decides without PyTorch (agents/policies/onnx_policy.py)."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn

from marl_sched.agents.networks.network import PolicyNetwork, RecurrentNetwork
from marl_sched.agents.networks.planner import PlannerNetwork
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.agents.policies.checkpoint import load_network
from marl_sched.agents.policies.onnx_policy import LOGITS, MEMORY, NEW_MEMORY, WEIGHTS
from marl_sched.agents.policies.trained import arrays_read
from marl_sched.errors import InvalidOptionError
from marl_sched.files import replacing
from marl_sched.graph import DECISION, GraphSpec

_ROWS, _FIRST_SIZE, _STEP = 3, 7, 2  # of the observation that the export follows: sizes that differ between types


class _Flat(nn.Module):
    """A network whose inputs are arrays in a fixed order, with its weights as they are applied."""

    def __init__(self, network: PolicyNetwork, names: list[str]) -> None:
        super().__init__()
        self._network, self._names = network, names
        self._weights = network.weights()

    def forward(self, *arrays: Tensor) -> Any:
        """Logits; of a recurrent network also the new memory."""
        observation = dict(zip(self._names, arrays, strict=True))
        if isinstance(self._network, RecurrentNetwork):
            return self._network.recur(observation, observation.pop(MEMORY))
        return self._network(observation, self._weights)


def export_onnx(policy: str | Path, path: str | Path) -> Path:
    """Write the policy whose weights or card are at `policy` to `path`, whole or not at all; the path.

    Any number of rows and of slots of each node type may be given to what is written. Raises as `load_network`, and
    InvalidOptionError for a policy that plans whole rounds.
    """
    network, card = load_network(policy)
    if isinstance(network, PlannerNetwork):
        raise InvalidOptionError(f"policy {policy}: plans whole rounds, expected one that decides turn by turn")
    network.eval().requires_grad_(False)
    names = arrays_read(card.graph)
    outputs = [LOGITS]
    example = _example(card.graph, names)
    if isinstance(network, RecurrentNetwork):
        names, outputs = [*names, MEMORY], [LOGITS, NEW_MEMORY]
        example = (*example, torch.zeros(_ROWS, network.memory_size))
    varying = tuple(_varying(array) for array in example)
    with _quiet():
        program = torch.onnx.export(
            _Flat(network, names).eval(),
            example,
            dynamo=True,
            input_names=names,
            output_names=outputs,
            dynamic_shapes=(varying,),
            verbose=False,
        )
    if program is None:
        raise RuntimeError("torch.onnx.export gave no program")
    model = _plain(program.model_proto, card)
    path = Path(path)
    with replacing(path) as temporary:
        temporary.write_bytes(model.SerializeToString(deterministic=True))
    return path


def _example(graph: GraphSpec, names: list[str]) -> tuple[Tensor, ...]:
    """An empty observation in which node types have sizes of their own, so that none is taken for another's."""
    sizes = {node.name: _FIRST_SIZE + _STEP * i for i, node in enumerate(graph.nodes)}
    sizes[DECISION] = sizes[graph.decision_of]
    arrays = graph.arrays(sizes)
    return tuple(torch.from_numpy(arrays[name].empty(_ROWS)) for name in names)


def _varying(array: Tensor) -> Mapping[int, Any]:
    """The axes whose sizes may differ: the batch, and slots of nodes; memories and features have theirs."""
    last = array.dim() - 1 if array.is_floating_point() and array.dim() > 1 else array.dim()
    return dict.fromkeys(range(last), torch.export.Dim.AUTO)


def _plain(model: onnx.ModelProto, card: PolicyCard) -> onnx.ModelProto:
    """The model without what the exporter notes of its source, but with the hash of its weights."""
    model.graph.ClearField("value_info")
    for part in (model, model.graph, *model.graph.node, *model.graph.input, *model.graph.output, *model.functions):
        part.ClearField("doc_string")
        if hasattr(part, "metadata_props"):
            part.ClearField("metadata_props")
    for tensor in model.graph.initializer:
        tensor.ClearField("metadata_props")
    model.metadata_props.add(key=WEIGHTS, value=card.weights_sha256)
    return model


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporter says of libraries that are not installed and of its own future."""
    logger = logging.getLogger("torch.onnx")
    before, logger.level = logger.level, logging.ERROR
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)

"""The full state of a training run, so that a resumed run goes on as if it had never stopped.

`checkpoint.json` holds the numbers and names the tensor file beside it, `checkpoint-UPDATE.safetensors`.
The JSON is written last and replaces the old one, so that at any moment there is one whole checkpoint.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from marl_sched.errors import InvalidFileError
from marl_sched.files import read_json, replacing, write_json
from marl_sched.train.learner import Learner

NAME = "checkpoint.json"
_COLLECTOR = "collector."


@dataclass
class Counters:
    """How far a run has come.

    Attributes:
        update: updates done.
        seconds: wall time of all updates.
        time: simulated time over all rows.
        decisions: turns taken.
        best: the best validation score so far, None before the first.
    """

    update: int = 0
    seconds: float = 0.0
    time: int = 0
    decisions: int = 0
    best: float | None = None


class Numbers(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `checkpoint.json` holds; `tensors` is the name of the other file, `learner` the learner's state."""

    tensors: str
    counters: Counters
    learner: dict[str, float | None]
    schema: Literal[3] = 3  # 2 called the counter of simulated time `hours`


def save_checkpoint(
    directory: Path,
    counters: Counters,
    learner: Learner,
    collector: Mapping[str, np.ndarray],
) -> None:
    """Write networks, optimizer, the states of learner and collector, and the counters."""
    if not learner.optimizer.state:  # before the first update
        _prepare(learner)
    tensors = {f"{_COLLECTOR}{name}": torch.from_numpy(array) for name, array in collector.items()}
    tensors |= _learned(learner)
    name = f"checkpoint-{counters.update:06d}.safetensors"
    with replacing(directory / name) as temporary:
        save_file({key: tensor.cpu().contiguous() for key, tensor in tensors.items()}, temporary)
    numbers = Numbers(tensors=name, counters=counters, learner=learner.state())
    write_json(directory / NAME, msgspec.to_builtins(numbers))
    for old in directory.glob("checkpoint-*.safetensors"):
        if old.name != name:
            old.unlink()


def load_checkpoint(
    directory: Path, learner: Learner, expected: Collection[str]
) -> tuple[Counters, dict[str, np.ndarray]]:
    """Put the learner back, on its own device; the counters and the collector's state, with the `expected` names.

    Raises InvalidFileError for a file that is missing, damaged or of another network.
    """
    try:
        numbers = msgspec.convert(_of_schema_3(read_json(directory / NAME)), Numbers)
    except msgspec.ValidationError as error:
        raise InvalidFileError(directory / NAME, "", f"a training checkpoint: {error}") from error
    path = directory / numbers.tensors
    try:
        saved = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InvalidFileError(path, "", f"a readable safetensors file ({error})") from error
    for name in expected:
        if _COLLECTOR + name not in saved:
            raise InvalidFileError(path, _COLLECTOR + name, "a tensor of that name")
    _prepare(learner)
    with torch.no_grad():
        for name, tensor in _learned(learner).items():
            if name not in saved or saved[name].shape != tensor.shape:
                raise InvalidFileError(path, name, f"a tensor of shape {tuple(tensor.shape)}")
            tensor.copy_(saved[name])
    learner.restore(numbers.learner)
    return numbers.counters, {name: saved[_COLLECTOR + name].numpy() for name in expected}


def _of_schema_3(content: Any) -> Any:
    """What a checkpoint file holds, brought from schema 2 to 3."""
    if not isinstance(content, dict) or content.get("schema") != 2 or not isinstance(content.get("counters"), dict):
        return content
    counters = {{"hours": "time"}.get(name, name): value for name, value in content["counters"].items()}
    return {**content, "schema": 3, "counters": counters}


def _learned(learner: Learner) -> dict[str, Tensor]:
    """Every tensor that learning changes, by name; the tensors themselves, not copies."""
    tensors: dict[str, Tensor] = {}
    for module_name, module in learner.modules.items():
        for name, parameter in module.named_parameters():
            tensors[f"{module_name}.{name}"] = parameter.data
            for key, value in learner.optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{key}.{module_name}.{name}"] = value
    return tensors


def _prepare(learner: Learner) -> None:
    """Give a fresh Adam the state that it otherwise makes in its first step."""
    for group in learner.optimizer.param_groups:
        for parameter in group["params"]:
            learner.optimizer.state[parameter] = {
                "step": torch.zeros((), dtype=torch.float32, device=parameter.device),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }

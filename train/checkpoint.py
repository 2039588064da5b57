"""The full state of a training run, so that a resumed run goes on as if it had never stopped.

`checkpoint.json` holds the numbers and names the tensor file beside it, `checkpoint-UPDATE.safetensors`.
The JSON is written last and replaces the old one, so that at any moment there is one whole checkpoint.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from marl_sched.errors import InvalidFileError
from marl_sched.files import read_json, replacing, write_json
from marl_sched.train.ppo import Ppo

NAME = "checkpoint.json"
SCHEMA = 1


def save_checkpoint(directory: Path, numbers: Mapping[str, Any], ppo: Ppo, collector: Mapping[str, np.ndarray]) -> None:
    """Write networks, optimizer and collector, and `numbers`, which JSON must be able to hold."""
    tensors = {f"collector.{name}": torch.from_numpy(np.atleast_1d(array)) for name, array in collector.items()}
    tensors |= _learned(ppo)
    name = f"checkpoint-{numbers['update']:06d}.safetensors"
    with replacing(directory / name) as temporary:
        save_file({key: tensor.contiguous() for key, tensor in tensors.items()}, temporary)
    write_json(directory / NAME, {"schema": SCHEMA, "tensors": name, **numbers})
    for old in directory.glob("checkpoint-*.safetensors"):
        if old.name != name:
            old.unlink()


def load_checkpoint(directory: Path, ppo: Ppo) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Put networks and optimizer back; the numbers and the collector's state that were saved with them.

    Raises InvalidFileError for a file that is missing, damaged or of another network.
    """
    numbers = read_json(directory / NAME)
    if not isinstance(numbers, dict) or numbers.get("schema") != SCHEMA:
        raise InvalidFileError(directory / NAME, "schema", str(SCHEMA))
    path = directory / str(numbers.get("tensors"))
    try:
        saved = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InvalidFileError(path, "", f"a readable safetensors file ({error})") from error
    collector = {
        name.removeprefix("collector."): t.numpy() for name, t in saved.items() if name.startswith("collector.")
    }
    _prepare(ppo)
    with torch.no_grad():
        for name, tensor in _learned(ppo).items():
            if name not in saved or saved[name].shape != tensor.shape:
                raise InvalidFileError(path, name, f"a tensor of shape {tuple(tensor.shape)}")
            tensor.copy_(saved[name])
    return numbers, collector


def _learned(ppo: Ppo) -> dict[str, Tensor]:
    """Every tensor that learning changes, by name; the tensors themselves, not copies."""
    tensors: dict[str, Tensor] = {}
    for module_name, module in ppo.modules.items():
        for name, parameter in module.named_parameters():
            tensors[f"{module_name}.{name}"] = parameter.data
            for key, value in ppo.optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{key}.{module_name}.{name}"] = value
    return tensors


def _prepare(ppo: Ppo) -> None:
    """Give a fresh Adam the state that it otherwise makes in its first step."""
    for group in ppo.optimizer.param_groups:
        for parameter in group["params"]:
            ppo.optimizer.state[parameter] = {
                "step": torch.zeros((), dtype=torch.float32),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }

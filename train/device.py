"""Where networks learn: on a GPU where one is at hand, or on the CPU, where everything else happens."""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn

from marl_sched.errors import InvalidOptionError

DeviceName = Literal["auto", "cpu", "cuda"]


def pick_device(name: DeviceName) -> torch.device:
    """The device that a configuration asks for; `auto` is CUDA where torch sees a device of it, else the CPU.

    Raises InvalidOptionError for `cuda` where there is none.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise InvalidOptionError("train: device: expected auto or cpu, got cuda, and torch sees no CUDA device here")
    return torch.device("cuda", torch.cuda.current_device())


def device_of(module: nn.Module) -> torch.device:
    """Where a module's parameters are, all on one device; the CPU if it has none."""
    return next((parameter.device for parameter in module.parameters()), torch.device("cpu"))


def described(device: torch.device) -> str:
    """A device as people know it, a GPU by its name too."""
    return f"{device} ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else str(device)

"""A GPU that is not there: tensors that say they are elsewhere, have their values on the CPU and keep apart from it.

What is computed is bit-equal to the CPU, so that a run on this device must end like one on the CPU; and whatever mixes
the two devices, or reads a tensor's values without bringing it to the CPU first, raises as it would on a real GPU.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map_only

GPU = torch.device("meta")
_aten = torch.ops.aten
_MOVES = {_aten._to_copy.default, _aten.copy_.default}  # from one device to the other
_JOINS = {_aten.cat.default, _aten.stack.default}  # do not even take a number from the CPU, as other operations do


class OnGpu(Tensor):
    """A tensor on the pretended GPU; `values` is on the CPU."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> OnGpu:
        return Tensor._make_wrapper_subclass(
            cls, values.shape, values.stride(), values.storage_offset(), dtype=values.dtype, device=GPU
        )

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __repr__(self) -> str:
        return f"OnGpu({self.values!r})"

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(function, args, kwargs or {})


class PretendedGpu(TorchDispatchMode):
    """Within it `cuda` names the pretended GPU."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(function, args, kwargs or {})


def _dispatch(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    given = tree_flatten((args, kwargs))[0]
    tensors = [value for value in given if isinstance(value, Tensor)]
    there = any(isinstance(tensor, OnGpu) for tensor in tensors)
    if not there and GPU not in [value for value in given if isinstance(value, torch.device)]:
        return function(*args, **kwargs)
    if torch.is_inference_mode_enabled():  # which leaves whole what autograd does not, such as Tensor.to
        with PretendedGpu():
            out = function.decompose(*args, **kwargs)
        if out is not NotImplemented:
            return out
    strangers = [t for t in tensors if not isinstance(t, OnGpu) and (t.dim() > 0 or function in _JOINS)]
    if there and strangers and function not in _MOVES:
        raise RuntimeError(f"{function}: expected all tensors to be on the same device, found the GPU and the CPU")
    wanted = kwargs.get("device")
    if wanted is not None:
        there = torch.device(wanted) == GPU
        kwargs = {**kwargs, "device": torch.device("cpu")}
    elif function is _aten.copy_.default:
        there = isinstance(args[0], OnGpu)
    out = function(*tree_map_only(OnGpu, _values, args), **tree_map_only(OnGpu, _values, kwargs))
    if not there:
        return out
    inference = torch.is_inference_mode_enabled() and all(tensor.is_inference() for tensor in tensors)
    with torch.inference_mode(inference):  # a view of a parameter is none of inference mode's tensors
        out = tree_map_only(Tensor, OnGpu, out)  # a number, as `item` gives, stays one
    return out if function is _aten._to_copy.default else return_and_correct_aliasing(function, args, kwargs, out)


def _values(tensor: OnGpu) -> Tensor:
    return tensor.values


@contextmanager
def pretended_gpu(patch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """A context in which networks, tensors and fused Adam can be on the device that it gives.

    It calls itself `meta`, for which alone every build of torch can differentiate without hardware.
    """
    adam = importlib.import_module("torch.optim.adam")  # which torch.optim does not keep by that name
    patch.setattr(adam, "_device_dtype_check_for_fused", lambda parameter: None)
    with PretendedGpu():
        yield GPU

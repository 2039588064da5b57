"""Compiled kernels called without the look-up of their arguments' types."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import typeof


def entry(kernel: Any, *arguments: Any) -> Callable[..., Any]:
    """The machine code of a Numba kernel for arguments of the types that these have, compiled if it has to be.

    A dispatcher finds out the type of every argument at every call. For named tuples of record arrays that takes
    longer (3 us) than an hour of a fleet (1 us). What comes back here skips it, so its callers must hand on arguments
    of exactly these types, contiguous where these are: arrays of another number of dimensions or item size raise
    TypeError, any other difference is not noticed.
    """
    return kernel.compile(tuple(typeof(argument) for argument in arguments))  # type: ignore[no-any-return]

"""Saying why the first run on a machine takes longer: simulators are compiled before they play."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer

PATIENCE = 1.0  # seconds of compilation that nobody needs to hear of


@contextmanager
def told_of_compilation(patience: float = PATIENCE) -> Iterator[None]:
    """Say on stderr that kernels are being compiled once that takes longer than `patience`, and at the end how long."""
    from numba.core import event

    listener = _listener(patience)
    with event.install_listener("numba:compile", listener):
        yield
    if listener.told:
        typer.echo(f"compiled {listener.kernels} kernels in {listener.seconds:.0f} s", err=True)


def _listener(patience: float) -> Any:
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        """Counts kernels and the seconds of the outermost ones: a kernel is compiled within the one that calls it."""

        kernels, depth, seconds, told, began = 0, 0, 0.0, False, 0.0

        def on_start(self, of: Any) -> None:
            """A kernel begins to be compiled."""
            if self.depth == 0:
                self.began = time.perf_counter()
            self.depth += 1
            so_far = self.seconds + time.perf_counter() - self.began
            if not self.told and so_far >= patience:
                self.told = True
                typer.echo(
                    "compiling the simulator: a minute or so, once for each version of the package on this machine",
                    err=True,
                )

        def on_end(self, of: Any) -> None:
            """A kernel is compiled."""
            self.kernels += 1
            self.depth -= 1
            if self.depth == 0:
                self.seconds += time.perf_counter() - self.began

    return Listener()

"""How far long work is: bars on a terminal, and a line every half minute where standard error is a file or a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

EVERY = 30.0  # seconds between two lines

Tell = Callable[[str, float], None]
"""(what, share done in [0, 1]) -> None."""


class Lines:
    """Tells how far work is in lines, `condition: 40 % done, about 90 s left`, at most one in `every` seconds.

    The time left assumes that the rest of a piece goes as fast as what is done of it.
    """

    def __init__(self, stream: TextIO, *, every: float = EVERY, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._every, self._clock = stream, every, clock
        self._began: dict[str, float] = {}
        self._told = clock()

    def __call__(self, what: str, done: float) -> None:
        """Note how far a piece of work is, and say so if it is time to."""
        now = self._clock()
        began = self._began.setdefault(what, now)
        if now - self._told < self._every:
            return
        self._told = now
        left = f", about {(now - began) * (1 - done) / done:.0f} s left" if done > 0 and now > began else ""
        print(f"{what}: {100 * done:.0f} % done{left}", file=self._stream, flush=True)


@contextmanager
def progress() -> Iterator[Tell]:
    """What long work tells its progress to: a bar for each name on a terminal, else lines on standard error."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    if not console.is_terminal:
        yield Lines(sys.stderr)
        return
    with Progress(console=console, transient=True) as bars:
        tasks = {}

        def tell(what: str, done: float) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=1.0)
            bars.update(tasks[what], completed=done)

        yield tell

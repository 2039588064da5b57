"""What protects a run's folder: one process at a time, and a checkpoint before an interrupted process ends."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from filelock import FileLock, Timeout

from marl_sched.errors import InvalidOptionError

LOCK = ".lock"


@contextmanager
def exclusive(directory: Path) -> Iterator[None]:
    """Hold a run's folder for this process; InvalidOptionError if another one holds it.

    The lock is the operating system's: it ends with the process, however that ends.
    """
    directory.mkdir(parents=True, exist_ok=True)
    lock = FileLock(directory / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InvalidOptionError(f"run_dir: another process trains in {directory}, choose another folder") from error
    try:
        yield
    finally:
        lock.release()


class Stop:
    """Whether SIGINT (Ctrl-C) or SIGTERM asked this process to stop, and which of them."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    @property
    def requested(self) -> bool:
        """Whether to stop after what is being done now."""
        return self.signal is not None

    def leave(self, message: str) -> None:
        """End the process as the signal that came would have, with a message on standard error; else nothing."""
        if self.signal is None:
            return
        print(message, file=sys.stderr)
        if self.signal == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + self.signal)


@contextmanager
def stopping() -> Iterator[Stop]:
    """Take note of the first SIGINT or SIGTERM instead of ending at once; the second one ends at once as usual.

    Signals come to the main thread alone; in another one nothing is noted.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: FrameType | None) -> None:
        stop.signal = signal.Signals(number)
        print(f"{stop.signal.name}: stops after this update; once more to stop at once", file=sys.stderr)
        restore()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    for number in before:
        signal.signal(number, note)
    try:
        yield stop
    finally:
        restore()

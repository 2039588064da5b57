"""SIGINT, SIGTERM and SIGHUP of the process that starts a deployment."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from marl_sched.comms.process import SIGNALS


@dataclass
class Stop:
    """Which signal has come. While nothing waits for it, a signal unwinds the stack instead."""

    number: int | None = None
    waiting: bool = False


@contextmanager
def stop_signals() -> Iterator[Stop]:
    """Take SIGINT, SIGTERM and SIGHUP, so that context managers end the processes; only in the main thread."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, frame: FrameType | None) -> None:
        again, stop.number = stop.number is not None, number
        if again or not stop.waiting:
            sys.exit(128 + number)

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

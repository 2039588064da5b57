"""What the processes of a run share: options as JSON, signals, one-line errors, an end with the parent."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from types import FrameType
from typing import Any, TypeVar

import msgspec

from marl_sched.comms.protocol.events import ExitCode, Interrupted
from marl_sched.comms.transport.base import Transport
from marl_sched.errors import InvalidOptionError, MarlSchedError

T = TypeVar("T")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LAST_WORDS = 5.0  # seconds to end tidily in when the parent is gone
_interrupted: list[int] = []  # the signals that `interruptible` took since the process began


def parse_options(text: str, kind: type[T]) -> T:
    """Options, a dataclass of type `kind`, from JSON; InvalidOptionError says which one is wrong."""
    try:
        values = msgspec.json.decode(text, type=dict[str, Any])
        unknown = sorted(set(values) - {field.name for field in fields(kind)})  # type: ignore[arg-type]  # a dataclass
        if unknown:
            raise InvalidOptionError(f"options: unknown {', '.join(unknown)}")
        return msgspec.convert(values, kind, dec_hook=_decode)
    except msgspec.DecodeError as error:
        raise InvalidOptionError(f"options: {error}") from error


def _decode(kind: type, content: Any) -> Any:
    """Msgspec's hook for what is no plain value."""
    from marl_sched.problem import Problem

    if kind is Problem:
        return Problem.from_json(content)
    raise NotImplementedError(kind)


@contextmanager
def interruptible(transport: Transport) -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP become an event of the transport's inbox; a second one ends the process at once.

    Does nothing in a thread that is not the main one, where Python hears no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        if _interrupted:
            sys.exit(128 + number)
        _interrupted.append(number)
        transport.inject(Interrupted(number))

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_process(
    kind: type[T],
    body: Callable[..., Any],
    exit_code: Callable[[Any], int] = lambda result: 0,
    argv: list[str] | None = None,
) -> None:
    """The main function of a process: parse options of type `kind`, call `body(options, progress)`, exit.

    Exits with `exit_code(result)`; with 2 and one line on stderr after a MarlSchedError; with 128 + n after signal n.
    With `--supervised` the process ends when its standard input does, so it never outlives the parent that holds the
    other end, and it prints its progress as JSON lines.
    """
    for number in SIGNALS:
        signal.signal(number, leave)
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("options", nargs="?", default="{}", help=f"{kind.__name__} as a JSON object")
    parser.add_argument("--supervised", action="store_true", help="end with the standard input, print progress")
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    if arguments.supervised:
        end_with(0)
    sys.exit(call(lambda: parse_options(arguments.options, kind), body, exit_code, arguments.supervised))


def call(options: Callable[[], T], body: Callable[..., Any], exit_code: Callable[[Any], int], supervised: bool) -> int:
    """Call a process's body; its exit code. Errors that a user can mend are one line on stderr."""
    try:
        result = body(options(), print_progress if supervised else None)
    except MarlSchedError as error:
        print(f"error: {error}", file=sys.stderr)
        return ExitCode.USER_ERROR
    return 128 + _interrupted[0] if _interrupted else exit_code(result)


def leave(number: int, frame: FrameType | None) -> None:
    """End the process by unwinding the main thread, which closes the session."""
    sys.exit(128 + number)


def end_with(pipe: int) -> None:
    """End this process when a pipe's other end is closed: by SIGTERM, and by force if that is not enough."""
    threading.Thread(target=_end_with, args=(pipe,), daemon=True).start()


def _end_with(pipe: int) -> None:
    while os.read(pipe, 1024):  # unbuffered: a buffered read here would block the interpreter's end
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(LAST_WORDS)
    os._exit(128 + signal.SIGTERM)  # the main thread is stuck, and nobody is left to end it


def print_progress(phase: str, tick: int, horizon: int) -> None:
    """One JSON line on stdout, in a single write: the fork server's lines go to the same pipe and must not split it.

    (`print` writes a line and its end one after the other if Python is not to buffer, as with PYTHONUNBUFFERED.)
    """
    sys.stdout.write(json.dumps({"phase": phase, "tick": tick, "horizon": horizon}) + "\n")
    sys.stdout.flush()

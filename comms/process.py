"""What the world's and the agents' processes share: options as JSON, one-line errors, and an end with their parent."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import fields
from types import FrameType
from typing import Any, TypeVar

import msgspec

from marl_sched.errors import InvalidOptionError, MarlSchedError

T = TypeVar("T")
USER_ERROR = 2
LAST_WORDS = 2.0  # seconds to end tidily in when the parent is gone


def parse_options(text: str, kind: type[T]) -> T:
    """Options, a dataclass of type `kind`, from JSON; InvalidOptionError says which one is wrong."""
    try:
        values = msgspec.json.decode(text, type=dict[str, Any])
        unknown = sorted(set(values) - {field.name for field in fields(kind)})  # type: ignore[arg-type]  # a dataclass
        if unknown:
            raise InvalidOptionError(f"options: unknown {', '.join(unknown)}")
        return msgspec.convert(values, kind)
    except msgspec.DecodeError as error:
        raise InvalidOptionError(f"options: {error}") from error


def run_process(kind: type[T], body: Callable[..., Any], argv: list[str] | None = None) -> None:
    """The main function of a process: parse options of type `kind`, call `body(options, progress)`, exit.

    Exits with 0; with 2 and one line on stderr after a MarlSchedError; with 128 + n after signal n. With
    `--supervised` the process ends when its standard input does, so it never outlives the parent that holds the
    other end, and it prints its progress as JSON lines.
    """
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("options", nargs="?", default="{}", help=f"{kind.__name__} as a JSON object")
    parser.add_argument("--supervised", action="store_true", help="end with the standard input, print progress")
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    signal.signal(signal.SIGTERM, _exit)
    if arguments.supervised:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        body(parse_options(arguments.options, kind), _print_progress if arguments.supervised else None)
    except MarlSchedError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)


def _exit(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)  # unwinds the main thread, which closes the session


def _end_with_parent() -> None:
    while os.read(0, 1024):  # unbuffered: a buffered read here would block the interpreter's end
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(LAST_WORDS)
    os._exit(128 + signal.SIGTERM)  # the main thread is stuck, and nobody is left to end it


def _print_progress(phase: str, moment: int, horizon: int) -> None:
    print(json.dumps({"phase": phase, "moment": moment, "horizon": horizon}), flush=True)

"""Counts what Zenoh refuses: connections without a valid certificate, and messages that the access rules deny.

Zenoh has no interface for it: it says so in its log, which it writes to standard output. While this listens, the
process's standard output is Zenoh's alone; what Python prints still goes where it went before.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

WARNINGS = "warn,zenoh::net::runtime::orchestrator=off,zenoh::net::routing::hat=error"  # but what is said elsewhere
WANTED = (  # and one line for each denied message
    f"{WARNINGS},zenoh::net::routing::interceptor=trace,zenoh::net::routing::interceptor::access_control=error"
)
DENIED, REFUSED = b"Msg intercepted!", b"zenoh_link_tls::unicast"
GIVEN_UP = re.compile(rb"eof|reset by peer|broken pipe|time", re.IGNORECASE)  # by the other side: nobody was refused
CHUNK = 1 << 16
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_started = threading.Event()  # Zenoh's log can be started once in a process


def log_warnings() -> None:
    """Let Zenoh write its warnings to standard output, or what the variable RUST_LOG asks for."""
    if not _started.is_set():
        _started.set()
        import zenoh

        zenoh.init_log_from_env_or(WARNINGS)


@contextmanager
def counted_refusals(count: Callable[[str, int], None], tell: Callable[[str], None]) -> Iterator[None]:
    """Call `count("denied", n)` and `count("refused", n)` for what Zenoh refuses, `tell(line)` for its other warnings.

    Both are called from a thread. When so much is refused that the lines do not fit into a pipe some are not counted:
    nobody waits for this log to be read. In a process in which Zenoh's log runs already nothing is counted.
    """
    if _started.is_set():
        yield
        return
    _started.set()
    import fcntl

    import zenoh

    sys.stdout.flush()
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 1 << 20)
    os.set_blocking(write, False)
    kept = os.dup(1)
    os.dup2(write, 1)
    os.close(write)
    printed, sys.stdout = sys.stdout, os.fdopen(os.dup(kept), "w", buffering=1)
    zenoh.init_log_from_env_or(WANTED)
    reader = threading.Thread(target=_read, args=(read, count, tell), daemon=True)
    reader.start()
    try:
        yield
    finally:
        sys.stdout.close()
        sys.stdout = printed
        os.dup2(kept, 1)  # the last writer of the pipe, which ends the reader
        os.close(kept)
        reader.join(1.0)


def _read(pipe: int, count: Callable[[str, int], None], tell: Callable[[str], None]) -> None:
    rest = b""
    while chunk := os.read(pipe, CHUNK):
        *lines, rest = (rest + chunk).split(b"\n")
        denied = sum(DENIED in line for line in lines)
        refused = [line for line in lines if REFUSED in line and not GIVEN_UP.search(line.partition(REFUSED)[2])]
        if denied:
            count("denied", denied)
        if refused:
            count("refused", len(refused))
        for line in lines:
            if DENIED not in line and line.strip():
                tell(_COLOURS.sub("", line.decode(errors="replace")))
    os.close(pipe)

"""The processes of a deployment as their parent sees them, and the fork server that starts them for it."""

from __future__ import annotations

import json
import logging
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marl_sched.comms.metrics.throttle import MAX_LINE
from marl_sched.errors import DeploymentError

log = logging.getLogger(__name__)
BEING_STARTED = -1  # in place of a process's id
LEAVE = 10.0  # seconds that processes have to leave when the run is over or interrupted


def last_line(path: Path) -> str:
    """The last line of a process's log."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    lines = text.strip().splitlines()
    return lines[-1].removeprefix("error: ") if lines else "it said nothing"


@dataclass
class Child:
    """A process of the deployment, through all its restarts.

    Attributes:
        pid: of the process that runs, 0 if none does, BEING_STARTED until the fork server says.
        exit_code: of the last one that ended, negative after a signal, None if none did.
        restarts: how often it was started again; `in_a_row` without having been steady.
        restart_at: when it is to be started again.
    """

    name: str
    log: Path  # what it writes to stderr
    start: Callable[[], None]
    pid: int = 0
    exit_code: int | None = None
    restarts: int = 0
    in_a_row: int = 0
    started_at: float = 0.0
    restart_at: float | None = None

    def complaint(self) -> str:
        """The last line that it wrote to stderr."""
        return last_line(self.log)


class ForkServerClient:
    """A fork server (marl_sched.comms.fork_server) as a child of this process.

    What it and the world say, as dicts, goes into a queue, and this object itself when it ends.
    """

    def __init__(self, asked: dict[str, Any], log: Path, said: queue.SimpleQueue[Said]) -> None:
        """Start it; `asked` is what its module's page says, `log` takes what it writes to stderr."""
        self._log, self._said = log, said
        with log.open("ab") as written:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "marl_sched.comms.fork_server", json.dumps(asked)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=written,
                env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C reaches this process alone, which then ends the others
            )
        threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True).start()

    def _listen(self, lines: Any) -> None:
        """Take in what the fork server and the world say; a line that neither of them wrote is logged."""
        for line in lines:
            try:
                said = json.loads(line)
            except ValueError:
                said = None
            if isinstance(said, dict):
                self._said.put(said)
            else:
                log.warning("a process of the run wrote a line that is no report of it: %r", line[:MAX_LINE])
        self._said.put(self)

    def order(self, **order: Any) -> None:
        """Have a process started or signalled; DeploymentError if the server is gone."""
        if self._process.stdin is None:
            raise self.failed()
        try:
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise self.failed() from error

    def failed(self) -> DeploymentError:
        """That it cannot start anything, and what it said last."""
        return DeploymentError(f"no process could be started: {last_line(self._log)}")

    def close(self) -> None:
        """End it and all its processes: it asks, waits, and kills."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(LEAVE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


Said = dict[str, Any] | ForkServerClient

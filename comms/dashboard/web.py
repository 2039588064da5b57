"""A read-only page on this machine that follows a run.

`/` is the page; its state comes as JSON by `/state`, as events by `/events`, and for Prometheus by `/metrics`.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from marl_sched.comms.dashboard.watcher import Watcher
from marl_sched.errors import DeploymentError

HOST = "127.0.0.1"
PERIOD = 0.5  # seconds between two events, at least
MAX_FOLLOWERS = 16  # pages that follow at once
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
PAGES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
}


class Server(ThreadingHTTPServer):
    """Serves a Watcher's state to browsers of this machine."""

    daemon_threads = True

    def __init__(self, watcher: Watcher, port: int) -> None:
        """Port 0 takes a free one. DeploymentError if it is in use."""
        self.watcher = watcher
        self.followers = threading.BoundedSemaphore(MAX_FOLLOWERS)
        try:
            super().__init__((HOST, port), Handler)
        except OSError as error:
            raise DeploymentError(f"cannot serve a page on {HOST}:{port}: {error.strerror}") from error

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/"


class Handler(BaseHTTPRequestHandler):
    """Answers GET, and nothing else, to those who ask for this machine by its name."""

    server: Server
    timeout = 30

    def do_GET(self) -> None:
        """A page, the state, the events, or the metrics."""
        host = (self.headers.get("Host") or "").rpartition(":")[0]
        if host not in (HOST, "localhost"):  # a page of elsewhere whose name was made to mean this machine
            self.send_error(HTTPStatus.FORBIDDEN, "ask for 127.0.0.1 or localhost")
        elif self.path in PAGES:
            name, kind = PAGES[self.path]
            self._send(kind, files("marl_sched.comms.dashboard").joinpath(name).read_bytes())
        elif self.path == "/state":
            self._send("application/json", json.dumps(self.server.watcher.state()).encode())
        elif self.path == "/events":
            self._stream()
        elif self.path == "/metrics":
            self._send_metrics()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self._headers(kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _send_metrics(self) -> None:
        try:
            from marl_sched.comms.dashboard.prometheus import CONTENT_TYPE, exposition
        except ModuleNotFoundError:
            self.send_error(HTTPStatus.NOT_IMPLEMENTED, "pip install 'marl-sched[metrics]'")
            return
        self._send(CONTENT_TYPE, exposition(self.server.watcher.state()))

    def _headers(self, kind: str) -> None:
        self.send_header("Content-Type", kind)
        for name, value in HEADERS.items():
            self.send_header(name, value)

    def _stream(self) -> None:
        if not self.server.followers.acquire(blocking=False):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages follow this run")
            return
        try:
            self.send_response(HTTPStatus.OK)
            self._headers("text/event-stream")
            self.end_headers()
            watcher, idle = self.server.watcher, threading.Event()
            while not watcher.ended:
                self.wfile.write(b"data: " + json.dumps(watcher.state()).encode() + b"\n\n")
                self.wfile.flush()
                idle.wait(PERIOD)
        except OSError:  # the browser has gone
            self.close_connection = True
        finally:
            self.server.followers.release()

    def log_message(self, format: str, *args: Any) -> None:
        """Nobody needs a line per request."""


@contextmanager
def serving(watcher: Watcher, port: int) -> Iterator[Server]:
    """Serve a page while the block lasts."""
    with Server(watcher, port) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()

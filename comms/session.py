"""A Zenoh session as the world and the agents use it: a star on explicit TCP endpoints, and one inbox.

The world is the hub: a peer that listens. Agents are clients that connect to it. Callbacks run on Zenoh's own
threads and do nothing but put an event into the inbox; whoever owns the link takes events out of it in its own
time. Scouting and shared memory are off, and a link that has been silent for a second counts as dead.
"""

from __future__ import annotations

import json
import queue
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple, Protocol

import zenoh

from marl_sched.comms.messages import run_prefix
from marl_sched.errors import DeploymentError, InvalidOptionError

LEASE_MS = 1000
# An hour's states go out in one burst. By default Zenoh drops what finds two batches in its queue for a millisecond,
# which on busy cores lost states, and every lost one cost its reader a resent turn and a snapshot.
QUEUE = 16  # batches, the most that Zenoh takes
DROP_AFTER_US = 50_000
CONNECT_SLICE = 1.0  # seconds for which an attempt to connect may keep a process from hearing signals
_ENDPOINT = re.compile(r"tcp/(?P<host>[^\s/:]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})")
EventKind = Literal["message", "alive", "gone", "query"]


class Event(NamedTuple):
    """Something that happened: a message, a liveliness token that came or went, or a query."""

    kind: EventKind
    key: str  # without the run's prefix
    payload: bytes = b""
    query: Any = None  # to be answered with Link.reply


class Transport(Protocol):
    """What the world and the agents need of a network; Link is the real one, tests have others."""

    def put(self, key: str, payload: bytes, *, reliable: bool = False) -> None:
        """Send; a message that is not `reliable` may be dropped where a listener is too slow."""

    def receive(self, timeout: float) -> Event | None:
        """The next event, None if none came within `timeout` seconds."""

    def subscribe(self, key: str) -> None:
        """Hear messages sent by other sessions on a key, which may hold wildcards."""

    def watch(self, key: str) -> None:
        """Hear of liveliness tokens, those already there included."""

    def announce(self, key: str) -> None:
        """Declare a liveliness token; it goes when the process does."""

    def withdraw(self, key: str) -> None:
        """Take back a liveliness token."""

    def serve(self, key: str) -> None:
        """Get queries on a key as events."""

    def reply(self, event: Event, payload: bytes) -> None:
        """Answer a query."""

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:
        """The answer to a query, None if none came within `timeout` seconds."""


class Link:
    """A session bound to a run; see Transport."""

    def __init__(self, session: zenoh.Session, run: str) -> None:
        self._session, self._prefix = session, run_prefix(run)
        self._inbox: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}

    def put(self, key: str, payload: bytes, *, reliable: bool = False) -> None:
        """See Transport.put."""
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        self._session.put(self._prefix + key, payload, express=True, congestion_control=control)

    def receive(self, timeout: float) -> Event | None:
        """See Transport.receive."""
        try:
            return self._inbox.get(timeout=max(timeout, 0.0))
        except queue.Empty:
            return None

    def subscribe(self, key: str) -> None:
        """See Transport.subscribe."""
        self._session.declare_subscriber(
            self._prefix + key,
            lambda sample: self._inbox.put(Event("message", self._local(sample.key_expr), sample.payload.to_bytes())),
            allowed_origin=zenoh.Locality.REMOTE,
        )

    def watch(self, key: str) -> None:
        """See Transport.watch."""

        def note(sample: zenoh.Sample) -> None:
            kind: EventKind = "alive" if sample.kind == zenoh.SampleKind.PUT else "gone"
            self._inbox.put(Event(kind, self._local(sample.key_expr)))

        self._session.liveliness().declare_subscriber(self._prefix + key, note, history=True)

    def announce(self, key: str) -> None:
        """See Transport.announce."""
        self._tokens[key] = self._session.liveliness().declare_token(self._prefix + key)

    def withdraw(self, key: str) -> None:
        """See Transport.withdraw."""
        self._tokens.pop(key).undeclare()

    def serve(self, key: str) -> None:
        """See Transport.serve."""

        def note(query: zenoh.Query) -> None:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            self._inbox.put(Event("query", self._local(query.key_expr), payload, query))

        self._session.declare_queryable(self._prefix + key, note)

    def reply(self, event: Event, payload: bytes) -> None:
        """See Transport.reply."""
        event.query.reply(event.query.key_expr, payload)
        event.query.drop()

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:
        """See Transport.ask."""
        for answer in self._session.get(self._prefix + key, payload=payload, timeout=timeout):
            if answer.ok is not None:
                return answer.ok.payload.to_bytes()
        return None

    def _local(self, key: Any) -> str:
        return str(key).removeprefix(self._prefix)


@contextmanager
def hub(run: str, endpoint: str) -> Iterator[Link]:
    """The world's session, listening on an endpoint such as `tcp/127.0.0.1:7447`."""
    check_endpoint("listen", endpoint)
    try:
        session = zenoh.open(_config(mode="peer", listen={"endpoints": [endpoint]}))
    except zenoh.ZError as error:
        in_use = "address already in use" in str(error).lower()
        why = "the port is in use" if in_use else _plain(error)
        raise DeploymentError(f"cannot listen on {endpoint}: {why}") from error
    with session:
        yield Link(session, run)


@contextmanager
def spoke(run: str, endpoint: str, timeout: float) -> Iterator[Link]:
    """An agent's session, connected to the world's endpoint; waits up to `timeout` seconds for it."""
    check_endpoint("connect", endpoint)
    end = time.monotonic() + timeout
    while isinstance(session := _connect(endpoint, min(CONNECT_SLICE, end - time.monotonic())), zenoh.ZError):
        if time.monotonic() >= end:
            raise DeploymentError(
                f"no world at {endpoint} within {timeout:g} s: {_why(endpoint, session)}"
            ) from session
    with session:
        yield Link(session, run)


def _connect(endpoint: str, seconds: float) -> zenoh.Session | zenoh.ZError:
    """A session connected to an endpoint, or why there was none in time. Signals wait for it to return."""
    retry = {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2.0}
    timeout_ms = max(int(seconds * 1000), 1)
    connect = {"endpoints": [endpoint], "timeout_ms": timeout_ms, "exit_on_failure": True, "retry": retry}
    try:
        return zenoh.open(_config(mode="client", connect=connect))
    except zenoh.ZError as error:
        return error


def _why(endpoint: str, error: zenoh.ZError) -> str:
    """Why a connection failed: what the system says of the endpoint, as Zenoh only says that it timed out."""
    try:
        with socket.create_connection(check_endpoint("connect", endpoint), CONNECT_SLICE):
            return _plain(error)
    except OSError as obstacle:
        return f"{obstacle.strerror or obstacle} ({_plain(error)})"


def _plain(error: zenoh.ZError) -> str:
    """What Zenoh says, without the places in its source."""
    return re.sub(r" at /\S+:\d+\.?", "", str(error)).strip()


def _config(**sections: Any) -> zenoh.Config:
    config = zenoh.Config()
    off = {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0}
    queues = {"size": {"data": QUEUE}, "congestion_control": {"drop": {"wait_before_drop": DROP_AFTER_US}}}
    transport = {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": LEASE_MS, "queue": queues}}}
    for key, value in _leaves({**sections, "scouting": off, "transport": transport}):
        config.insert_json5(key, json.dumps(value))
    return config


def _leaves(tree: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of a nested mapping; `retry` is one value, as Zenoh takes it whole."""
    for name, value in tree.items():
        place = f"{path}/{name}" if path else name
        if isinstance(value, dict) and name != "retry":
            yield from _leaves(value, place)
        else:
            yield place, value


def check_endpoint(option: str, endpoint: str) -> tuple[str, int]:
    """(host, port) of a TCP endpoint, or InvalidOptionError."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match["port"]) > 65535:
        raise InvalidOptionError(f"{option}: expected an endpoint such as tcp/127.0.0.1:7447, got {endpoint!r}")
    return match["host"].strip("[]"), int(match["port"])


def settle_port(endpoint: str) -> str:
    """The endpoint with a free port in place of port 0; DeploymentError if its port is in use or not ours to use."""
    host, port = check_endpoint("listen", endpoint)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise DeploymentError(f"cannot listen on {endpoint}: {error.strerror}") from error
        port = probe.getsockname()[1]
    return f"{endpoint.rsplit(':', 1)[0]}:{port}"

"""Zenoh as the world and the agents use it: a star on explicit TCP endpoints, and one bounded inbox.

The world is the hub: a peer that listens. Agents are clients that connect to it. Callbacks run on Zenoh's own threads
and do nothing but put an event into the inbox; the newest state of each channel waits in a ring of Zenoh's own until a
turn needs it. Scouting and shared memory are off. Nothing is sent with Zenoh's
blocking congestion control, so that no reader, however slow or frozen, can hold up a sender; the protocol sends
again what is lost.

The hub's access rules (`marl_sched.comms.security.access`) let agents' keys in and nothing else: whoever connects can
neither say what the world says nor answer in its place, and agents' decisions are relayed to nobody. On a `tls/`
endpoint both sides show certificates, and the rules tell agents apart.
"""

from __future__ import annotations

import itertools
import json
import logging
import re
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh

from marl_sched.comms.protocol.events import Answered, Event, Queried, Received, TokenAppeared, TokenVanished
from marl_sched.comms.protocol.keys import MAX_KEY, run_prefix
from marl_sched.comms.security.access import named_rules, open_rules
from marl_sched.comms.security.identity import Identity
from marl_sched.comms.transport.base import MAX_PAYLOAD
from marl_sched.comms.transport.endpoints import check_endpoint, is_encrypted, split_endpoints
from marl_sched.comms.transport.inbox import Inbox
from marl_sched.errors import DeploymentError, InvalidOptionError

log = logging.getLogger(__name__)
DEFAULT_LEASE = 1.0  # seconds of silence after which a link counts as dead
QUEUE = 16  # batches that may wait on a link, the most that Zenoh takes
DROP_AFTER_US = 2000  # for which a full link may hold up a message before it is dropped
CONNECT_SLICE = 1.0  # seconds for which an attempt to connect may keep a process from hearing signals
KNOCK, KNOCK_AGAIN = 10.0, 0.2  # seconds that a TLS handshake may take, and until the next
MAX_QUERIES, MAX_ALIKE = 256, 4  # that wait for an answer, in all and by one key; more are dropped
QUERY_TIMEOUT = 10.0
CLOSE_S = 1.0  # for which a session may take to close
LOOK_AGAIN = 0.001  # seconds until somebody who is attentive looks into the rings again
ACCEPT_MS = 2000  # for which a connection may be half open


class ZenohTransport:
    """A session bound to a run; see Transport."""

    def __init__(self, run: str, connect: Callable[[], zenoh.Session]) -> None:
        self._prefix, self._connect = run_prefix(run), connect
        self._inbox = Inbox()
        self.dropped: Counter[str] = self._inbox.dropped
        self._queries: dict[int, zenoh.Query] = {}
        self._queries_lock, self._query_numbers = threading.Lock(), itertools.count(1)
        self._session = connect()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._subscribers: dict[str, Any] = {}
        self._rings: dict[str, Any] = {}  # subscribers of one quiet key each, with its newest sample

    def put(self, key: str, payload: bytes, *, control: bool = False) -> None:
        """See Transport.put."""
        self._session.put(self._prefix + key, payload, express=control, congestion_control=zenoh.CongestionControl.DROP)

    def receive(self, timeout: float, *, attentive: bool = True) -> Event | None:
        """See Transport.receive."""
        if not attentive or not self._rings:
            return self._inbox.get(timeout)
        end = time.monotonic() + timeout
        while True:
            self._collect()
            left = end - time.monotonic()
            event = self._inbox.get(min(LOOK_AGAIN, max(left, 0.0)))
            if event is not None or left <= LOOK_AGAIN:
                return event

    def _collect(self) -> None:
        """Take quiet samples out of Zenoh's rings, in which no Python code looks at them."""
        for ring in self._rings.values():
            sample = ring.try_recv()
            if sample is not None:
                self._take_in(sample)

    def _take_in(self, sample: zenoh.Sample) -> None:
        name = self._local(sample.key_expr)
        if len(sample.payload) > MAX_PAYLOAD or len(name) > MAX_KEY:
            self.dropped["too_long"] += 1
        else:
            self._inbox.put(name, Received(name, sample.payload.to_bytes()))

    def inject(self, event: Event) -> None:
        """See Transport.inject."""
        self._inbox.inject(event)

    def subscribe(self, key: str, *, quiet: bool = False) -> None:
        """See Transport.subscribe."""
        origin, name = zenoh.Locality.REMOTE, self._prefix + key
        if quiet:
            ring: Any = zenoh.handlers.RingChannel(1)
            self._rings[key] = self._session.declare_subscriber(name, ring, allowed_origin=origin)
        else:
            self._subscribers[key] = self._session.declare_subscriber(name, self._take_in, allowed_origin=origin)

    def unsubscribe(self, key: str) -> None:
        """See Transport.unsubscribe."""
        (self._rings if key in self._rings else self._subscribers).pop(key).undeclare()

    def watch(self, key: str) -> None:
        """See Transport.watch."""

        def note(sample: zenoh.Sample) -> None:
            name = self._local(sample.key_expr)
            if len(name) > MAX_KEY:
                self.dropped["too_long"] += 1
                return
            stands = sample.kind == zenoh.SampleKind.PUT
            self._inbox.put(("token", name), TokenAppeared(name) if stands else TokenVanished(name))

        self._subscribers[key] = self._session.liveliness().declare_subscriber(self._prefix + key, note, history=True)

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
            with self._queries_lock:
                alike = sum(waits.key_expr == query.key_expr for waits in self._queries.values())
                if len(self._queries) >= MAX_QUERIES or alike >= MAX_ALIKE or len(payload) > MAX_PAYLOAD:
                    self.dropped["no_place"] += 1
                    query.drop()
                    return
                number = next(self._query_numbers)
                self._queries[number] = query
            self._inbox.put(("query", number), Queried(self._local(query.key_expr), payload, number))

        self._subscribers[key] = self._session.declare_queryable(self._prefix + key, note)

    def reply(self, query: int, payload: bytes | None) -> None:
        """See Transport.reply; None closes the query without an answer."""
        with self._queries_lock:
            asked = self._queries.pop(query)
        if payload is not None:
            asked.reply(asked.key_expr, payload)
        asked.drop()

    def ask(self, question: int, key: str, payload: bytes) -> None:
        """See Transport.ask."""

        def note(answer: zenoh.Reply) -> None:
            if answer.ok is not None and len(answer.ok.payload) <= MAX_PAYLOAD:
                self._inbox.put(("answer", question), Answered(question, answer.ok.payload.to_bytes()))

        self._session.get(self._prefix + key, note, payload=payload, timeout=QUERY_TIMEOUT)

    def reopen(self) -> None:
        """See Transport.reopen."""
        self.close()
        self._session = self._connect()

    def close(self) -> None:
        """See Transport.close."""
        self._tokens, self._subscribers, self._rings = {}, {}, {}
        close_soon(self._session)

    def _local(self, key: Any) -> str:
        return str(key).removeprefix(self._prefix)


def close_soon(session: zenoh.Session) -> None:
    """Close a session, in CLOSE_S at most. Zenoh waits 10 s for a peer that is frozen, and nobody waits for that."""
    closing = threading.Thread(target=_close, args=(session,), daemon=True)
    closing.start()
    closing.join(CLOSE_S)


def _close(session: zenoh.Session) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        log.warning("the session did not close: %s", _plain(error))


def hub(
    run: str,
    endpoint: str,
    prefix: str,
    lease: float = DEFAULT_LEASE,
    *,
    identity: Identity | None = None,
    channels: Sequence[Sequence[str]] = (),
) -> ZenohTransport:
    """The world's session, listening on an endpoint such as `tls/127.0.0.1:7447`.

    `prefix` is that of agents' names. With `identity`, the world's certificate, agents must show theirs, and agent i
    hears `channels[i]`. DeploymentError if the endpoint is in use, InvalidOptionError for `tls/` without a certificate
    or another protocol with one.
    """
    _check_encryption(endpoint, identity)
    rules = open_rules(run, prefix) if identity is None else named_rules(run, prefix, channels)
    config = config_of(endpoint, lease, identity, mode="peer", listen={"endpoints": [endpoint]}, access_control=rules)

    def connect() -> zenoh.Session:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            in_use = "address already in use" in str(error).lower()
            why = "the port is in use" if in_use else _plain(error)
            raise DeploymentError(f"cannot listen on {endpoint}: {why}") from error

    return ZenohTransport(run, connect)


def spoke(
    run: str, endpoint: str, timeout: float, lease: float = DEFAULT_LEASE, *, identity: Identity | None = None
) -> ZenohTransport:
    """An agent's session, connected to the world's endpoint or to one of several routers'.

    It waits up to `timeout` seconds for it. Where there are several, separated by commas, another one is connected to
    when the first is gone.

    `identity` is the agent's certificate, which a `tls/` endpoint asks for; InvalidOptionError as for `hub`.
    """
    _check_encryption(endpoint, identity)

    def connect() -> zenoh.Session:
        end = time.monotonic() + timeout
        while True:
            obstacle: Exception | None = None
            if identity is not None:
                obstacle = _knock_at_any(endpoint, min(KNOCK, max(end - time.monotonic(), 0.01)), identity)
            if obstacle is None:
                session = _connect(endpoint, min(CONNECT_SLICE, end - time.monotonic()), lease, identity)
                if not isinstance(session, zenoh.ZError):
                    return session
                obstacle = session
            else:
                time.sleep(KNOCK_AGAIN)
            if time.monotonic() >= end:
                why = _why(endpoint, obstacle)
                raise DeploymentError(f"no world at {endpoint} within {timeout:g} s: {why}") from obstacle

    return ZenohTransport(run, connect)


def _check_encryption(endpoint: str, identity: Identity | None) -> None:
    if is_encrypted(endpoint) != (identity is not None):
        raise InvalidOptionError(f"{endpoint}: {'needs certificates' if identity is None else 'takes no certificates'}")


def _connect(endpoint: str, seconds: float, lease: float, identity: Identity | None) -> zenoh.Session | zenoh.ZError:
    """A session connected to an endpoint, or why there was none in time. Signals wait for it to return."""
    retry = {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2.0}
    timeout_ms = max(int(seconds * 1000), 1)
    endpoints = split_endpoints(endpoint)
    connect = {"endpoints": endpoints, "timeout_ms": timeout_ms, "exit_on_failure": True, "retry": retry}
    try:
        return zenoh.open(config_of(endpoint, lease, identity, mode="client", connect=connect))
    except zenoh.ZError as error:
        return error


def _knock_at_any(endpoints: str, seconds: float, identity: Identity) -> OSError | None:
    """As `_knock`, at one endpoint after the other until one answers."""
    obstacle: OSError | None = None
    for endpoint in split_endpoints(endpoints):
        obstacle = _knock(endpoint, seconds, identity)
        if obstacle is None:
            return None
    return obstacle


def _knock(endpoint: str, seconds: float, identity: Identity) -> OSError | None:
    """Shake hands with a TLS listener; what kept it from answering, None if it did. Signals are heard meanwhile.

    A listener that was frozen looks at every connection that was given up, ten in a second, before it comes to one that
    waits still. Zenoh's short attempts, one after the other, would keep agents out for ever; this one waits.
    """
    end = time.monotonic() + seconds
    host, port = check_endpoint("connect", endpoint)
    try:
        context = ssl.create_default_context(cafile=identity.authority)
        context.load_cert_chain(identity.certificate, identity.key)
        with socket.create_connection((host, port), seconds) as raw:
            raw.settimeout(max(end - time.monotonic(), 0.01))
            context.wrap_socket(raw, server_hostname=host).close()
    except OSError as error:
        return error
    return None


def _why(endpoint: str, error: Exception) -> str:
    """Why a connection failed: what the system says of the endpoint, as Zenoh only says that it timed out."""
    if not isinstance(error, zenoh.ZError):
        return str(error)
    try:
        with socket.create_connection(check_endpoint("connect", split_endpoints(endpoint)[0]), CONNECT_SLICE):
            return _plain(error)
    except OSError as obstacle:
        return f"{obstacle.strerror or obstacle} ({_plain(error)})"


def _plain(error: zenoh.ZError) -> str:
    """What Zenoh says, without the places in its source."""
    return re.sub(r" at /\S+:\d+\.?", "", str(error)).strip()


def config_of(endpoint: str, lease: float, identity: Identity | None, **sections: Any) -> zenoh.Config:
    """A session's configuration: explicit endpoints, no scouting, no shared memory, nothing that blocks a sender."""
    queue = {"size": {"data": QUEUE}, "congestion_control": {"drop": {"wait_before_drop": DROP_AFTER_US}}}
    link: dict[str, Any] = {
        "tx": {"lease": int(lease * 1000), "queue": queue},
        "rx": {"max_message_size": 2 * MAX_PAYLOAD},
        "protocols": [endpoint.partition("/")[0]],
    }
    if identity is not None:
        link["tls"] = _certificates(identity, [way for way in ("listen", "connect") if way in sections])
    whole: Mapping[str, Any] = {
        **sections,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
        "transport": {"shared_memory": {"enabled": False}, "unicast": {"accept_timeout": ACCEPT_MS}, "link": link},
    }
    return zenoh.Config.from_json5(json.dumps(whole))


def _certificates(identity: Identity, ways: Sequence[str]) -> dict[str, Any]:
    shown = {
        name: str(path)
        for way in ways
        for name, path in ((f"{way}_certificate", identity.certificate), (f"{way}_private_key", identity.key))
    }
    return {
        "root_ca_certificate": str(identity.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        **shown,
    }

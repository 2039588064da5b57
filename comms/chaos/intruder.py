"""A process that attacks a run: `python -m marl_sched.comms.chaos.intruder '{"endpoint": ..., "run": ..., ...}'`.

It uses Zenoh with its own defaults, not this package's transport, as an intruder or a badly written dashboard would.
With `certs` and `name` it shows that certificate: it is then an agent's process that was taken over. It says `ready`
when it is connected, and how often it did what, as JSON, at the end. What it does:

- `listen`: subscribes to everything; `read-slowly`: likewise, and takes 50 ms for each message.
- `forge`: what an attack on an earlier version of this deployment did, once or a few times each.
- `flood`: garbage and forgeries by old and ever new keys, as fast as possible for `seconds`.
- `connect`: attempts to connect without a certificate, with one of another authority, with garbage, and half open ones.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.transport.endpoints import check_endpoint
from marl_sched.errors import InvalidMessageError

LATE = 2**62 - 1  # the largest sequence there is
HALF_OPEN = 50
CONNECT_MS = 500


class Order(msgspec.Struct, frozen=True, kw_only=True):
    """What to do: where, to which run, as whom, and against which agent; `channels` are some of its view's."""

    what: str
    endpoint: str
    run: str
    certs: str = ""
    name: str = ""
    prefix: str = "agent"
    victim: int = 0
    channels: tuple[str, ...] = ()
    seconds: float = 5.0


def configuration(order: Order, folder: str, name: str) -> zenoh.Config:
    """Zenoh's defaults, but for where to connect to and the certificate."""
    link: dict[str, Any] = {}
    if folder:
        link["tls"] = {"root_ca_certificate": f"{folder}/ca.pem"}
    if name:
        link["tls"] |= {
            "enable_mtls": True,
            "connect_certificate": f"{folder}/{name}.pem",
            "connect_private_key": f"{folder}/{name}.key",
        }
    whole = {
        "mode": "client",
        "connect": {"endpoints": [order.endpoint], "timeout_ms": CONNECT_MS, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": link},
    }
    return zenoh.Config.from_json5(json.dumps(whole))


def forgeries(order: Order, epoch: str, number: int) -> list[tuple[str, bytes]]:
    """(key, payload) of messages that nobody but the world or the victim may say; `number` makes them new."""
    us = {"run": order.run, "epoch": epoch if number % 2 else f"forged-{number}"}
    victim, prefix = order.victim, order.prefix
    other_version = msgspec.msgpack.encode({"type": "hello.1", "agent": victim, "incarnation": "x", "policy": "p"})
    said: list[tuple[str, wire.Message]] = [
        ("world/clock", wire.Clock(**us, tick=1, phase="over")),
        (f"{prefix}/{victim}/turn", wire.Refused(**us, reason="forged")),
        (
            f"{prefix}/{victim}/decision",
            wire.Decision(**us, tick=number, agent=victim, incarnation="x", sequence=number, action=1, remembered=None),
        ),
        (f"{prefix}/{victim}/hello", wire.Hello(**us, agent=victim, incarnation=f"x-{number}", policy="forged")),
        (f"{prefix}/{victim}/hello", wire.Beat(**us, agent=victim, incarnation="x", tick=LATE, counts={})),
        *((channel, wire.News(**us, channel=channel, sequence=LATE, payload=b"forged")) for channel in order.channels),
    ]
    return [
        *((key, wire.encode(message)) for key, message in said),
        (f"{prefix}/{victim}/hello", other_version),
        (f"{prefix}/{'9' * 5000}/decision", b"garbage"),
        (f"{prefix}/{number}/decision", bytes(200)),
    ]


def epoch_of(session: zenoh.Session, order: Order) -> str:
    """The world's epoch, as it tells everybody who may ask."""
    for reply in session.get(f"marl_sched/{order.run}/world/frame", timeout=1.0):
        if reply.ok is not None:
            return msgspec.msgpack.decode(reply.ok.payload.to_bytes(), type=wire.Frame).epoch
    return "unknown"


def usurped(said: bytes) -> bytes | None:
    """The answer to somebody else's turn, None if that is something else."""
    try:
        turn = wire.decode(said, wire.Turn)
    except InvalidMessageError:
        return None
    names = ("run", "epoch", "tick", "agent", "incarnation", "sequence")
    return wire.encode(wire.Decision(**{name: getattr(turn, name) for name in names}, action=1))


def listen(session: zenoh.Session, order: Order, count: Counter[str], slow: float) -> None:
    """Subscribe to everything of the run and to all that anybody may hear, and take `slow` seconds per message."""

    def note(sample: zenoh.Sample) -> None:
        count["heard"] += 1
        time.sleep(slow)

    root = f"marl_sched/{order.run}/"
    heard = [
        "**",
        f"{root}world/clock",
        f"{root}{order.prefix}/{order.victim}/turn",
        *(root + c for c in order.channels),
    ]
    subscribers = [session.declare_subscriber(key, note) for key in heard]
    count["subscriptions"] = len(subscribers)
    print("ready", flush=True)
    time.sleep(order.seconds)


def attack(session: zenoh.Session, order: Order, count: Counter[str], rounds: int | None) -> None:
    """Say everything that is not this process's to say, `rounds` times 50 ms apart, or without a pause."""
    root = f"marl_sched/{order.run}/"
    turns: deque[bytes] = deque(maxlen=1)  # the victim's, if they can be heard
    victim = f"{root}{order.prefix}/{order.victim}"
    subscriber = session.declare_subscriber(
        f"{victim}/turn", lambda sample: turns.append(sample.payload.to_bytes()), allowed_origin=zenoh.Locality.REMOTE
    )
    epoch = epoch_of(session, order)
    queryables = [session.declare_queryable(f"{root}world/frame", lambda query: query.reply(query.key_expr, b"forged"))]
    end = time.monotonic() + order.seconds
    print("ready", flush=True)
    number = 0
    while time.monotonic() < end and (rounds is None or number < rounds):
        number += 1
        for key, payload in forgeries(order, epoch, number):
            session.put(root + key, payload)
            count["put"] += 1
        if rounds is not None or number % 50 == 0:
            for token in (f"forged-{number}", "9" * 5000):
                key = f"{root}{order.prefix}/{order.victim if token[0] == 'f' else token}/alive/{token[:40]}"
                session.liveliness().declare_token(key).undeclare()
                count["tokens"] += 1
            session.get(f"{root}world/snapshot/{order.victim}", lambda reply: None, payload=b"garbage", timeout=1.0)
            count["queries"] += 1
        for _ in range(25 if rounds is not None else 0):
            if turns and (answer := usurped(turns.pop())) is not None:
                session.put(f"{victim}/decision", answer)
                count["usurped"] += 1
            time.sleep(0.002)
    subscriber.undeclare()
    for queryable in queryables:
        queryable.undeclare()


def connect(order: Order, count: Counter[str]) -> None:
    """Try to get in without the right to."""
    from marl_sched.comms.security.certificates import make_certificates

    print("ready", flush=True)
    with tempfile.TemporaryDirectory() as other:
        make_certificates(Path(other), ["world", order.name or f"{order.prefix}_{order.victim}"])
        name = order.name or f"{order.prefix}_{order.victim}"
        attempts: list[Callable[[], zenoh.Config]] = [
            lambda: configuration(order, order.certs, ""),
            lambda: configuration(order, other, name),
        ]
        for attempt in attempts * 3:
            try:
                zenoh.open(attempt()).close()
                count["let_in"] += 1
            except zenoh.ZError:
                count["refused"] += 1
    address = check_endpoint("endpoint", order.endpoint)
    half_open = [socket.create_connection(address) for _ in range(HALF_OPEN)]
    for one in half_open[: HALF_OPEN // 2]:
        one.sendall(os.urandom(4000))
        count["garbage"] += 1
    count["half_open"] = HALF_OPEN
    time.sleep(max(order.seconds - len(attempts) * 3 * CONNECT_MS / 1000, 0.5))
    for one in half_open:
        one.close()


def main() -> None:
    """The process."""
    order = msgspec.json.decode(sys.argv[1], type=Order)
    count: Counter[str] = Counter()
    if order.what == "connect":
        connect(order, count)
    else:
        with zenoh.open(configuration(order, order.certs, order.name)) as session:
            if order.what in ("listen", "read-slowly"):
                listen(session, order, count, 0.05 if order.what == "read-slowly" else 0.0)
            else:
                attack(session, order, count, 40 if order.what == "forge" else None)
    print(json.dumps(count), flush=True)


if __name__ == "__main__":
    main()

"""An operator's orders to a running world, by the protocol of comms/PROTOCOL.md."""

from __future__ import annotations

import time
import uuid
from pathlib import Path
from typing import Any

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.commands import WORDS
from marl_sched.comms.security.identity import OPERATOR, Identity
from marl_sched.comms.transport.base import Transport
from marl_sched.errors import DeploymentError, InvalidOptionError, require


def order_of(run: str, kind: str, **fields: Any) -> wire.Message:
    """The message that orders `kind`, one of WORDS; fields that are None are left out.

    Raises UnknownNameError for another word, InvalidOptionError for a field that it does not have or lacks.
    """
    message = WORDS[require("order", kind, WORDS)]
    given = {name: value for name, value in fields.items() if value is not None}
    try:
        return message(run=run, epoch="", request=uuid.uuid4().hex, kind=kind, **given)  # type: ignore[call-arg]
    except TypeError as error:
        raise InvalidOptionError(f"order {kind}: {error}") from error


def give(transport: Transport, order: wire.Message, seconds: float) -> None:
    """Order, and wait for the answer; DeploymentError with the world's reason if it declines, or does not answer."""
    transport.ask(1, keys.COMMAND, wire.encode(order))
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        event = transport.receive(left)
        if isinstance(event, ev.Answered) and event.payload is not None:
            answer = wire.decode(event.payload, wire.Accepted, wire.Declined)
            if isinstance(answer, wire.Declined):
                raise DeploymentError(f"the world declines: {answer.reason}")
            return
    raise DeploymentError(f"no answer within {seconds:g} s: no such run, or this certificate may not order")


def send(order: wire.Message, connect: str, certs: str, seconds: float = 5.0) -> None:
    """Connect to a world as its operator and order; raises as `give` and where there is no world."""
    from marl_sched.comms.transport.zenoh_session import spoke

    transport = spoke(order.run, connect, seconds, identity=Identity(Path(certs), OPERATOR))
    try:
        give(transport, order, seconds)
    finally:
        transport.close()

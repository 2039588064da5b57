"""What the world and the agents need of a network; Zenoh and the network in memory offer it."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

from marl_sched.comms.protocol.events import Event

MAX_PAYLOAD = 1 << 22  # bytes of a message that is taken in


class Transport(Protocol):
    """A session of one run. Keys are given and handed out without the run's prefix.

    Attributes:
        dropped: what was thrown away before anybody looked at it, kind -> count.
    """

    dropped: Counter[str]

    def put(self, key: str, payload: bytes, *, control: bool = False) -> None:
        """Send. What is not `control` may wait for a moment to travel with more of its kind."""

    def receive(self, timeout: float, *, attentive: bool = True) -> Event | None:
        """The next event, None if none came within `timeout` seconds; quiet ones only for who is `attentive`."""

    def inject(self, event: Event) -> None:
        """Have `receive` return an event of this process itself; may be called from a signal handler."""

    def subscribe(self, key: str, *, quiet: bool = False) -> None:
        """Hear messages sent by other sessions on a key, which may hold wildcards; `quiet` ones wake nobody."""

    def unsubscribe(self, key: str) -> None:
        """Hear them no longer."""

    def watch(self, key: str) -> None:
        """Hear of liveliness tokens, those already there included."""

    def announce(self, key: str) -> None:
        """Declare a liveliness token; it goes when the process does."""

    def withdraw(self, key: str) -> None:
        """Take back a liveliness token."""

    def serve(self, key: str) -> None:
        """Get queries on a key as events."""

    def reply(self, query: int, payload: bytes | None) -> None:
        """Answer a query; None closes it without an answer."""

    def ask(self, question: int, key: str, payload: bytes) -> None:
        """Put a question; Answered(question, ...) follows, unless nobody answers."""

    def reopen(self) -> None:
        """Close the session and open it again; DeploymentError if that does not succeed in time."""

    def close(self) -> None:
        """End the session."""

"""A transport that loses, delays, repeats and reorders what is sent through it, by a seed, and counts what it did.

TCP does none of this; a run is played over it (`faults` of a world or an agent) to see what the protocol makes of it.
"""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.comms.transport.base import Transport

REORDERED = 0.02  # seconds for which a message that is to be overtaken is held back


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What happens to each message.

    Attributes:
        loss, duplicate, reorder: with which probability it is lost, sent twice, or held back so that others pass it.
        delay: it comes late by a uniform share of so many seconds.
        seed: of the draws; each process has draws of its own.
    """

    loss: float = 0.0
    delay: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what is no probability."""
        for name in ("loss", "duplicate", "reorder"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidOptionError(f"faults: {name}: expected a probability, got {getattr(self, name)}")
        if not self.delay >= 0:
            raise InvalidOptionError(f"faults: delay: expected a number >= 0 (seconds), got {self.delay}")

    @classmethod
    def of(cls, given: Mapping[str, float]) -> Faults:
        """Faults by their names; InvalidOptionError for one that does not exist."""
        unknown = set(given) - {field.name for field in fields(cls)}
        if unknown:
            raise InvalidOptionError(f"faults: unknown {', '.join(sorted(unknown))}")
        return cls(**{name: value for name, value in given.items() if name != "seed"}, seed=int(given.get("seed", 0)))


class FaultyTransport:
    """A Transport around another one; what is sent and asked is subject to faults, all else passes.

    Attributes:
        injected: kind of fault -> how many messages it hit.
    """

    def __init__(self, inner: Transport, faults: Faults, stream: int) -> None:
        """`stream` tells the draws of this process from those of others."""
        self._inner, self._faults = inner, faults
        self._random = np.random.default_rng((faults.seed, stream))
        self.injected: Counter[str] = Counter()
        self._late: list[tuple[float, int, Callable[[], None]]] = []
        self._count, self._wake, self._closed = itertools.count(), threading.Condition(), False
        self._thread = threading.Thread(target=self._send_late, daemon=True)
        self._thread.start()

    def __getattr__(self, name: str) -> Any:
        """Everything that is not sent is the inner transport's."""
        return getattr(self._inner, name)

    def put(self, key: str, payload: bytes, *, control: bool = False) -> None:
        """See Transport.put."""
        self._subject(lambda: self._inner.put(key, payload, control=control))

    def ask(self, question: int, key: str, payload: bytes) -> None:
        """See Transport.ask."""
        self._subject(lambda: self._inner.ask(question, key, payload))

    def close(self) -> None:
        """See Transport.close; what is late by then is lost."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        self._thread.join()
        self._inner.close()

    def _subject(self, send: Callable[[], None]) -> None:
        faults = self._faults
        lost, twice, held, share = self._random.random(4)
        if lost < faults.loss:
            self.injected["loss"] += 1
            return
        late = share * faults.delay
        if late > 0:
            self.injected["delay"] += 1
        if held < faults.reorder:
            self.injected["reorder"] += 1
            late += REORDERED
        self._send(send, late)
        if twice < faults.duplicate:
            self.injected["duplicate"] += 1
            self._send(send, late)

    def _send(self, send: Callable[[], None], late: float) -> None:
        if late == 0:
            send()
            return
        with self._wake:
            heapq.heappush(self._late, (time.monotonic() + late, next(self._count), send))
            self._wake.notify()

    def _send_late(self) -> None:
        while True:
            with self._wake:
                while not self._closed and (not self._late or self._late[0][0] > time.monotonic()):
                    self._wake.wait(max(self._late[0][0] - time.monotonic(), 0.0) if self._late else None)
                if self._closed:
                    return
                send = heapq.heappop(self._late)[2]
            send()

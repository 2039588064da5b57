"""A bounded inbox between the threads that hear and the one that decides: one place per sender, kind and key."""

from __future__ import annotations

import queue
import threading
from collections import Counter
from collections.abc import Hashable

from marl_sched.comms.protocol.events import Event

MAX_PENDING = 4096  # places that are taken at most; what finds none is dropped and counted


class Inbox:
    """Events wait here, at most one in each place: a newer one takes the place of an older one that waits still.

    So a sender that floods one key costs one place, and what waits is always the newest. What is `quiet` wakes nobody
    who is not attentive: it waits, the newest of each place, until somebody is. `dropped` counts what was replaced
    (`replaced`), quiet events apart, and what found no place (`no_place`). Safe to use from several threads.
    """

    def __init__(self, max_pending: int = MAX_PENDING) -> None:
        self.dropped: Counter[str] = Counter()
        self._max = max_pending
        self._places: dict[Hashable, Event] = {}
        self._quiet: dict[Hashable, None] = {}  # places of which nobody has been told
        self._attentive = True
        self._lock = threading.Lock()
        self._ready: queue.SimpleQueue[Hashable | Event] = queue.SimpleQueue()

    def put(self, place: Hashable, event: Event, *, quiet: bool = False) -> bool:
        """Let an event wait in a place; False if there was none left."""
        with self._lock:
            waits = place in self._places
            if not waits and len(self._places) >= self._max:
                self.dropped["no_place"] += 1
                return False
            self._places[place] = event
            if place in self._quiet:
                return True
            if not waits and quiet and not self._attentive:
                self._quiet[place] = None
                return True
        if waits:
            self.dropped["replaced"] += 1
        else:
            self._ready.put(("place", place))
        return True

    def inject(self, event: Event) -> None:
        """Let an event of this process itself wait; may be called from a signal handler, as it takes no lock."""
        self._ready.put(event)

    def get(self, timeout: float, *, attentive: bool = True) -> Event | None:
        """The event that has waited longest, None if there was none within `timeout` seconds.

        Who is `attentive` also gets quiet ones, those that wait already behind all others.
        """
        with self._lock:
            self._attentive = attentive
            if attentive and self._quiet:
                for place in self._quiet:
                    self._ready.put(("place", place))
                self._quiet.clear()
        try:
            item = self._ready.get(timeout=timeout) if timeout > 0 else self._ready.get_nowait()
        except queue.Empty:
            return None
        if not isinstance(item, tuple):
            return item  # type: ignore[return-value]  # what inject put in
        with self._lock:
            return self._places.pop(item[1])

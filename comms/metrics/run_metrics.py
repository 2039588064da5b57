"""Everything counted in a run, in memory that does not grow with its length."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from msgspec import Struct

from marl_sched.comms.metrics.histogram import Histogram
from marl_sched.comms.protocol.keys import kind_of

MAX_EVENTS = 10_000
# `stale`: decisions that answer no open turn: late, repeated, or of an incarnation that was given up. `contradicted`:
# a second decision for a turn with another action. `other_epoch`: said to another run or life of the world.
# `unanswered`: queries beyond what the world answers in a second. `replaced`, `no_place`, `too_long`: dropped unseen.
# `denied`: messages, subscriptions and tokens that the access rules let neither in nor out. `refused`: connections
# without a valid certificate.
COUNTS = (
    "conflicts", "illegal", "missed_deadlines", "tick_overruns", "stale", "contradicted", "fenced", "unparsed",
    "other_epoch", "unanswered", "replaced", "no_place", "too_long", "denied", "refused",
)  # fmt: skip


class RunEvent(Struct, frozen=True, kw_only=True):
    """What befell an agent, or the world: it joined, was lost, was late, ...; it was waited for `waited_s` seconds."""

    time: int
    agent: str
    event: str
    waited_s: float


class Volume(Struct, frozen=True):
    """Messages of one kind, and their bytes."""

    count: int
    bytes: int


class Traffic(Struct, frozen=True, kw_only=True):
    """What the world said and heard, by kind, and in all."""

    sent: dict[str, Volume]
    heard: dict[str, Volume]
    count: int
    bytes: int


class Latency(Struct, frozen=True, kw_only=True):
    """Median and 99th percentile of the time from a turn to its decision, ms; None if there was no decision."""

    p50: float | None
    p99: float | None


@dataclass
class RunMetrics:
    """Counts of one run; times in simulated units unless named `_s` or `_ms`."""

    events: list[RunEvent] = field(default_factory=list)  # the first MAX_EVENTS
    latency: Histogram = field(default_factory=Histogram)  # seconds from a turn to its decision
    share_sum: float = 0.0  # of the graph that deciding agents saw
    turns: int = 0
    standstill_s: float = 0.0
    slept_s: float = 0.0
    longest_pause_s: float = 0.0  # between two decisions that were applied
    applied_at: float | None = None
    playing_s: float = 0.0  # from the first decisions that were applied to the last
    sent: Counter[str] = field(default_factory=Counter)
    sent_bytes: Counter[str] = field(default_factory=Counter)
    heard: Counter[str] = field(default_factory=Counter)
    heard_bytes: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    injected: Counter[str] = field(default_factory=Counter)  # faults of the world's own messages, by kind
    _kinds: dict[str, str] = field(default_factory=dict)  # of the world's own keys, whose number is fixed

    def note_applied(self, now: float) -> None:
        """Note that decisions were applied."""
        if self.applied_at is not None:
            self.longest_pause_s = max(self.longest_pause_s, now - self.applied_at)
            self.playing_s += now - self.applied_at
        self.applied_at = now

    def note_sent(self, key: str, payload: bytes) -> None:
        """Count a message of the world."""
        kind = self._kinds.get(key)
        if kind is None:
            kind = self._kinds[key] = kind_of(key)
        self.sent[kind] += 1
        self.sent_bytes[kind] += len(payload)

    def note_heard(self, kind: str, payload: bytes) -> None:
        """Count a message to the world; `kind` is one of few words, whatever its key was."""
        self.heard[kind] += 1
        self.heard_bytes[kind] += len(payload)

    def note_event(self, time: int, agent: str, event: str, waited_s: float = 0.0) -> None:
        """Note that an agent joined, was lost, was late, ..."""
        if len(self.events) >= MAX_EVENTS:
            self.counts["events_not_kept"] += 1
            return
        self.events.append(RunEvent(time=time, agent=agent, event=event, waited_s=round(waited_s, 4)))

    def latency_ms(self) -> Latency:
        """Of all decisions so far."""
        quantiles = (self.latency.quantile(share) for share in (0.5, 0.99))
        median, high = (None if value is None else round(value * 1000, 4) for value in quantiles)
        return Latency(p50=median, p99=high)

    def messages(self) -> Traffic:
        """Counts and bytes by kind, both ways, with totals."""
        return Traffic(
            sent={kind: Volume(self.sent[kind], self.sent_bytes[kind]) for kind in sorted(self.sent)},
            heard={kind: Volume(self.heard[kind], self.heard_bytes[kind]) for kind in sorted(self.heard)},
            count=self.sent.total() + self.heard.total(),
            bytes=self.sent_bytes.total() + self.heard_bytes.total(),
        )

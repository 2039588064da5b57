"""What is written down of a distributed run: JSON-ready books of turns, messages and mishaps."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.comms.messages import kind_of
from marl_sched.comms.roster import most_misses

if TYPE_CHECKING:
    from marl_sched.comms.options import WorldOptions
    from marl_sched.comms.roster import Roster
    from marl_sched.simulation import TurnSimulator

SCHEMA = 1
# How a turn went: answered in time, answered with what is impossible in truth or in the agent's view, not answered
# in time, nobody there to ask. In all but the first the agent idles for this moment.
DECIDED, CONFLICT, ILLEGAL, LATE, ABSENT = "decided", "conflict", "illegal", "late", "absent"

# What happens to agents. Two of these are deaths: its liveliness token went (the process ended, froze or was cut off),
# or it missed too many deadlines in a row.
JOINED, GONE, SILENT = "joined", "gone", "silent"
# `stale` are decisions that answer no open turn: late, repeated, or of an incarnation that the world gave up.
COUNTS = ("conflicts", "illegal", "missed_deadlines", "stale", "fenced", "unparsed")


@dataclass
class Books:
    """Everything counted in a run; times in simulated units unless named `_s` or `_ms`."""

    decisions: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)  # one per turn
    latencies: list[float] = field(default_factory=list)  # seconds from a turn to its decision
    shares: list[float] = field(default_factory=list)  # of the graph that the deciding agent saw
    sent: Counter[str] = field(default_factory=Counter)
    sent_bytes: Counter[str] = field(default_factory=Counter)
    heard: Counter[str] = field(default_factory=Counter)
    heard_bytes: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)  # conflicts, illegal choices, missed deadlines, ...

    def note_sent(self, key: str, payload: bytes) -> None:
        """Count a message of the world."""
        self.sent[kind_of(key)] += 1
        self.sent_bytes[kind_of(key)] += len(payload)

    def note_heard(self, key: str, payload: bytes) -> None:
        """Count a message of an agent; one that does not parse is counted too."""
        self.heard[kind_of(key)] += 1
        self.heard_bytes[kind_of(key)] += len(payload)

    def note_event(self, moment: str, time: int, agent: str, event: str, waited_s: float = 0.0) -> None:
        """Note that an agent joined, died, was late, ..."""
        self.events.append({moment: time, "agent": agent, "event": event, "waited_s": round(waited_s, 4)})

    def latency_ms(self) -> dict[str, float | None]:
        """Median and 99th percentile of the time from a turn to its decision, None if there was no decision."""
        if not self.latencies:
            return {"p50": None, "p99": None}
        p50, p99 = np.percentile(np.array(self.latencies) * 1000, [50, 99])
        return {"p50": round(float(p50), 4), "p99": round(float(p99), 4)}

    def messages(self) -> dict[str, Any]:
        """Counts and bytes by kind, both ways, with totals."""
        ways = {"sent": (self.sent, self.sent_bytes), "heard": (self.heard, self.heard_bytes)}
        out: dict[str, Any] = {
            way: {kind: {"count": counts[kind], "bytes": sizes[kind]} for kind in sorted(counts)}
            for way, (counts, sizes) in ways.items()
        }
        out["count"] = self.sent.total() + self.heard.total()
        out["bytes"] = self.sent_bytes.total() + self.heard_bytes.total()
        return out


def absent(events: list[dict[str, Any]]) -> set[str]:
    """The agents that died and did not come back."""
    last = {event["agent"]: event["event"] for event in events if event["event"] in (JOINED, GONE, SILENT)}
    return {agent for agent, event in last.items() if event != JOINED}


def build(
    options: WorldOptions, simulator: TurnSimulator, roster: Roster, books: Books, seconds: float
) -> dict[str, Any]:
    """The report of a run that came to its end, ready for JSON."""
    domain = options.domain()
    series = options.telemetry().series(simulator)
    objectives = {name: float(values[0]) for name, values in simulator.objectives().items()}
    objective = options.objective or domain.objectives[0]
    view = {"kind": options.view, **options.view_options}
    return {
        "schema": SCHEMA,
        "env": domain.name,
        "scale": None if options.instance else options.scale,
        "instance": options.instance or None,
        "seed": options.seed,
        "hours": int(simulator.time[0]),
        "objective": objective,
        "view": {**view, "visible_share": round(float(np.mean(books.shares)), 4) if books.shares else None},
        "M1": objectives[objective],
        "objectives": objectives,
        **series,
        "agents": [
            {
                "name": domain.agent_name(i),
                "policy": seat.policy,
                "turns": seat.turns,
                "waited_s": round(seat.waited_in_all, 4),
            }
            for i, seat in enumerate(roster.seats)
        ],
        "decisions": books.decisions,
        "rewards": books.rewards,
        "messages": books.messages(),
        "latency_ms": books.latency_ms(),
        **{name: books.counts[name] for name in COUNTS},
        "deaths": [event for event in books.events if event["event"] in (GONE, SILENT)],
        "events": books.events,
        "run": options.run,
        "deadline_s": options.deadline,
        # The most that one agent, dead, slow or returning, delays the others in vain between two of its decisions in
        # time, in all its incarnations together; the milliseconds that the world takes to notice come on top.
        "delay_bound_s": round(options.deadline * most_misses(options.patience), 6),
        "seconds": round(seconds, 3),
    }

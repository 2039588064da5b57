"""The report of a run: what was decided, what it cost, what went wrong, ready for JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from marl_sched.comms.membership.slots import Slot, max_misses
from marl_sched.comms.metrics.run_metrics import COUNTS, RunMetrics
from marl_sched.comms.protocol.events import End, Ending, ExitCode

if TYPE_CHECKING:
    from marl_sched.comms.options import WorldOptions
    from marl_sched.comms.plant import Commit

SCHEMA = 2
LOSSES = ("lost", "silent")  # events by which an agent is given up


def absent_agents(events: list[dict[str, Any]]) -> set[str]:
    """The agents that were given up and did not come back."""
    last = {event["agent"]: event["event"] for event in events if event["event"] in ("joined", *LOSSES)}
    return {agent for agent, event in last.items() if event != "joined"}


def exit_code(ending: End, slots: Sequence[Slot]) -> int:
    """What the world's process ends with; see PROTOCOL.md."""
    if ending.ending == Ending.INTERRUPTED:
        return 128 + int(ending.reason.removeprefix("signal "))
    codes = {
        Ending.COMPLETE: ExitCode.AGENTS_LOST if any(slot.losses for slot in slots) else ExitCode.COMPLETE,
        Ending.QUORUM_LOST: ExitCode.QUORUM_LOST,
        Ending.NOT_GATHERED: ExitCode.USER_ERROR,
    }
    return int(codes.get(ending.ending, ExitCode.DEFECT))


def build_report(
    options: WorldOptions,
    *,
    ending: End,
    summary: dict[str, Any],
    commits: Iterable[Commit],
    slots: Sequence[Slot],
    metrics: RunMetrics,
    seconds: float,
) -> dict[str, Any]:
    """The report of a run, however it ended. `summary` is the plant's, see Plant.summary."""
    domain, telemetry = options.domain(), options.telemetry()
    objective = options.chosen_objective()
    listed = list(commits)
    summary = dict(summary)
    figures: dict[str, list[float]] = summary.pop("agent_figures")
    shares = [commit.share for commit in listed]
    return {
        "schema": SCHEMA,
        "ending": {"kind": str(ending.ending), "reason": ending.reason or None, "exit_code": exit_code(ending, slots)},
        "env": domain.name,
        "scale": None if options.instance else options.scale,
        "instance": options.instance or None,
        "seed": options.seed,
        "unit": domain.unit,
        "objective": objective,
        "view": {
            "kind": options.view,
            **options.view_options,
            "visible_share": round(sum(shares) / len(shares), 4) if shares else None,
        },
        "M1": summary["objectives"][objective],
        **summary,
        "agents": [
            {
                "name": domain.agent_name(i),
                "policy": slot.policy,
                "state": str(slot.state),
                "turns": slot.turns,
                "losses": slot.losses,
                "waited_s": round(slot.waited_in_all, 4),
                "counts": slot.counts,
                "figures": {name: values[i] for name, values in figures.items()},
            }
            for i, slot in enumerate(slots)
        ],
        "decisions": [
            {
                telemetry.time_unit: commit.tick,
                "agent": domain.agent_name(commit.agent),
                "action": commit.action,
                "outcome": str(commit.outcome),
            }
            for commit in listed
        ],
        "rewards": [commit.reward for commit in listed],
        "messages": metrics.messages(),
        "latency_ms": metrics.latency_ms(),
        **{name: metrics.counts[name] for name in COUNTS},
        "injected": dict(metrics.injected),
        "deaths": [event for event in metrics.events if event["event"] in LOSSES],
        "events": metrics.events,
        "events_not_kept": metrics.counts["events_not_kept"],
        "run": options.run,
        "clock": options.clock,
        "deadline_s": options.deadline,
        # The most that one agent that is there and slow delays the others in vain before it is barred, in all its
        # incarnations together.
        "delay_bound_s": round(options.deadline * max_misses(options.patience), 6),
        "standstill_s": round(metrics.standstill_s, 3),
        "longest_pause_s": round(metrics.longest_pause_s, 3),
        "slept_s": round(metrics.slept_s, 3),
        "seconds": round(seconds, 3),
    }

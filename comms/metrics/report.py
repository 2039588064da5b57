"""The report of a run: what was decided, what it cost, what went wrong, ready for JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct, ValidationError, convert, to_builtins

from marl_sched.comms.membership.slots import Slot, max_misses
from marl_sched.comms.metrics.run_metrics import COUNTS, Latency, RunEvent, RunMetrics, Traffic
from marl_sched.comms.protocol.events import End, Ending, ExitCode
from marl_sched.errors import InvalidFileError
from marl_sched.problem import Problem, view_as_json

if TYPE_CHECKING:
    from marl_sched.comms.options import WorldOptions
    from marl_sched.comms.plant import Commit, PlantSummary

SCHEMA = 2
LOSSES = ("lost", "silent")  # events by which an agent is given up


class Ended(Struct, frozen=True, kw_only=True):
    """How a run ended; `reason` is None where it came to its end."""

    kind: str
    reason: str | None
    exit_code: int


class MemoryReport(Struct, frozen=True, kw_only=True):
    """The memory of an agent's last incarnation that decided: since which simulated time, and of how many decisions."""

    began: int
    decisions: int


class AgentReport(Struct, frozen=True, kw_only=True):
    """What an agent's slot saw of its incarnations.

    Attributes:
        memory: None for an agent without one.
        counts: what the agent counted itself.
        figures: what the domain counts of it (`TurnSimulator.agent_figures`).
    """

    name: str
    policy: str
    state: str
    turns: int
    losses: int
    waited_s: float
    memory: MemoryReport | None = None
    counts: dict[str, int]
    figures: dict[str, float]


class Decided(Struct, frozen=True, kw_only=True):
    """A turn, and what became of it."""

    time: int
    agent: str
    action: int
    outcome: str


class RunReport(Struct, frozen=True, kw_only=True):
    """What a run came to, however it ended. `as_json` is what files hold, `from_json` reads it again.

    Attributes:
        unit, time_unit: what the horizon and simulated time count.
        view: as JSON; `visible_share` is the mean share of the graph that deciding agents saw, None without a turn.
        time: simulated time at the end.
        progress: how much of the horizon had passed, in `unit`.
        objectives: means over the run, by name; `M1` is that of the run's objective.
        series: objectives of every unit of time.
        rewards: one for each decision.
        counts: what went wrong how often, by the names of COUNTS.
        injected: faults of the world's own messages, by kind.
        events, events_not_kept: the first MAX_EVENTS, and how many there were beyond.
        delay_bound_s: the most that one agent that is there and slow delays the others in vain before it is barred, in
            all its incarnations together.
        playing_s: from the first decisions that were applied to the last; longest_pause_s: between two of them.
        exit_codes, restarts, seconds_in_all: of all processes, where a launcher started them.
        from_log: the log that the run was played again from.
    """

    ending: Ended
    env: str
    scale: str | None
    instance: str | None
    seed: int
    unit: str
    time_unit: str
    objective: str
    view: dict[str, Any]
    visible_share: float | None
    time: int
    progress: int
    objectives: dict[str, float]
    series: dict[str, list[float]]
    agents: list[AgentReport]
    decisions: list[Decided]
    rewards: list[float]
    messages: Traffic
    latency_ms: Latency
    counts: dict[str, int]
    injected: dict[str, int]
    events: list[RunEvent]
    events_not_kept: int
    run: str
    clock: str
    deadline_s: float
    delay_bound_s: float
    standstill_s: float
    playing_s: float
    longest_pause_s: float
    slept_s: float
    seconds: float
    exit_codes: dict[str, int | None] | None = None
    restarts: dict[str, int] | None = None
    seconds_in_all: float | None = None
    from_log: str | None = None

    @property
    def M1(self) -> float:  # noqa: N802  (as everywhere)
        """The run's objective."""
        return self.objectives[self.objective]

    @property
    def deaths(self) -> list[RunEvent]:
        """The events by which agents were given up."""
        return [event for event in self.events if event.event in LOSSES]

    @property
    def absent(self) -> set[str]:
        """The agents that were given up and did not come back."""
        last = {event.agent: event.event for event in self.events if event.event in ("joined", *LOSSES)}
        return {agent for agent, event in last.items() if event != "joined"}

    def as_json(self) -> dict[str, Any]:
        """Schema 2: times by the name of their unit, series and counts at the top, nothing that is not given."""
        data = to_builtins(self)
        view = {**data.pop("view"), "visible_share": data.pop("visible_share")}
        series, counts = data.pop("series"), data.pop("counts")
        for name in _OF_LAUNCHERS:
            if data[name] is None:
                del data[name]
        events, decisions = (self._by_unit(data.pop(name)) for name in ("events", "decisions"))
        deaths = [event for event in events if event["event"] in LOSSES]
        return {
            "schema": SCHEMA, **data, "view": view, "M1": self.M1, **series, "decisions": decisions, **counts,
            "deaths": deaths, "events": events,
        }  # fmt: skip

    def _by_unit(self, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{self.time_unit if name == "time" else name: value for name, value in row.items()} for row in rows]

    @classmethod
    def from_json(cls, data: dict[str, Any], where: str | Path) -> RunReport:
        """What `as_json` gave; InvalidFileError, which names `where`, for something else."""
        try:
            unit, view = data["time_unit"], dict(data["view"])
            times = {
                rows: [{"time" if name == unit else name: value for name, value in row.items()} for row in data[rows]]
                for rows in ("events", "decisions")
            }
            plain = {
                **data,
                **times,
                "visible_share": view.pop("visible_share"),
                "view": view,
                "series": {name: data[name] for name in data["objectives"] if isinstance(data.get(name), list)},
                "counts": {name: data[name] for name in COUNTS if name in data},
            }
            return convert(plain, cls)
        except (KeyError, TypeError, AttributeError, ValidationError) as error:
            raise InvalidFileError(where, "", f"the report of a run ({error!r})") from error


_OF_LAUNCHERS = ("exit_codes", "restarts", "seconds_in_all", "from_log")


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


def _file(problem: Problem) -> str | None:
    """The file of the instance, None if it was drawn or given as an object."""
    return str(problem.files[0]) if problem.files and problem.files[0] else None


def build_report(
    options: WorldOptions,
    *,
    ending: End,
    summary: PlantSummary,
    commits: Iterable[Commit],
    slots: Sequence[Slot],
    metrics: RunMetrics,
    seconds: float,
    from_log: str | None = None,
) -> RunReport:
    """The report of a run, however it ended."""
    problem, listed = options.problem, list(commits)
    domain, shares = problem.domain, [commit.share for commit in listed]
    return RunReport(
        ending=Ended(kind=str(ending.ending), reason=ending.reason or None, exit_code=exit_code(ending, slots)),
        env=domain.name,
        scale=problem.scale,
        instance=_file(problem),
        seed=problem.seed,
        unit=domain.unit,
        time_unit=options.telemetry().time_unit,
        objective=problem.objective,
        view=view_as_json(problem.view),
        visible_share=round(sum(shares) / len(shares), 4) if shares else None,
        time=summary.time,
        progress=summary.progress,
        objectives=summary.objectives,
        series=summary.series,
        agents=[_agent(domain.agent_name(i), slot, summary.of_agent(i)) for i, slot in enumerate(slots)],
        decisions=[
            Decided(
                time=commit.tick,
                agent=domain.agent_name(commit.agent),
                action=commit.action,
                outcome=str(commit.outcome),
            )
            for commit in listed
        ],
        rewards=[commit.reward for commit in listed],
        messages=metrics.messages(),
        latency_ms=metrics.latency_ms(),
        counts={name: metrics.counts[name] for name in COUNTS},
        injected=dict(metrics.injected),
        events=list(metrics.events),
        events_not_kept=metrics.counts["events_not_kept"],
        run=options.run,
        clock=options.clock,
        deadline_s=options.deadline,
        delay_bound_s=round(options.deadline * max_misses(options.patience), 6),
        standstill_s=round(metrics.standstill_s, 3),
        playing_s=round(metrics.playing_s, 6),
        longest_pause_s=round(metrics.longest_pause_s, 3),
        slept_s=round(metrics.slept_s, 3),
        seconds=round(seconds, 3),
        from_log=from_log,
    )


def _agent(name: str, slot: Slot, figures: dict[str, float]) -> AgentReport:
    return AgentReport(
        name=name,
        policy=slot.policy,
        state=str(slot.state),
        turns=slot.turns,
        losses=slot.losses,
        waited_s=round(slot.waited_in_all, 4),
        memory=_memory(slot),
        counts=dict(slot.counts),
        figures=figures,
    )


def _memory(slot: Slot) -> MemoryReport | None:
    if slot.memory_began is None:
        return None
    return MemoryReport(began=slot.memory_began, decisions=(slot.remembered or 0) + 1)

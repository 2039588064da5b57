"""Runs cases and says what came of them: a row each, a table of all."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tabulate import tabulate

from marl_sched.comms.chaos.audit import reference, violations
from marl_sched.comms.chaos.cases import CASES, Case
from marl_sched.comms.chaos.fuzz import fuzz
from marl_sched.comms.chaos.scene import Scene
from marl_sched.comms.chaos.stops import end_many, plan, processes_of
from marl_sched.comms.metrics.report import RunReport
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.protocol.events import ExitCode
from marl_sched.comms.transport.endpoints import settle_port, split_endpoints
from marl_sched.errors import MarlSchedError

ENDLESS = 10**6  # a horizon that no case comes to
MAX_PAUSE = 1.0  # seconds for which an attack may hold up a run
TERMINATED = 128 + 15


@dataclass(frozen=True, kw_only=True)
class Row:
    """What came of a case.

    Attributes:
        secure: whether there were certificates.
        faults: kind -> how often it occurred.
        time, decisions: how far the run came.
        pause_s: the longest time between two decisions, of the world's last life.
        heard_s: the longest time after a fault until every agent was heard again.
        cost: by how many percent of the run without faults the objective was worse.
        denied, refused: messages and connections that the network let not through.
        problems: what was not as it must be, a sentence each.
    """

    case: str
    secure: bool
    faults: dict[str, int] = field(default_factory=dict)
    time: int = 0
    decisions: int = 0
    pause_s: float = 0.0
    heard_s: float | None = None
    cost: float | None = None
    denied: int = 0
    refused: int = 0
    seconds: float = 0.0
    problems: list[str] = field(default_factory=list)


def run_case(case: Case, world: WorldOptions, policy: str, folder: Path) -> Row:
    """Play one case in a new folder; a run that cannot be brought to its end is a problem of the row."""
    started = time.monotonic()
    world = replace(world, **case.world, problem=world.problem.but(horizon=ENDLESS))
    options = DeployOptions(world=world, policy=policy, folder=str(folder))
    problems: list[str] = []
    row = Row(case=case.name, secure=not world.insecure)
    scene = None
    try:
        with Scene(options, case.behind) as scene:
            scene.start()
            case.fault(scene)
            report = scene.end()
        late = report.counts["missed_deadlines"] + report.counts["tick_overruns"]
        scene.faults.update({"late": late} if late else {})
        row = replace(
            row,
            time=report.time,
            decisions=len(report.decisions),
            pause_s=report.longest_pause_s,
            heard_s=None if scene.heard_s is None else round(scene.heard_s, 2),
            denied=report.counts["denied"],
            refused=report.counts["refused"],
        )
        calm = replace(world, faults={})
        problems += violations(calm, folder / "run.jsonl", scene.before, report)
        decided, objective = reference(calm, policy, report.time)
        row = replace(row, cost=_cost(calm, objective, report.M1))
        problems += _judged(case, row, report, scene, decided)
    except MarlSchedError as error:
        problems.append(f"{type(error).__name__}: {error}")
    if scene is not None:
        row = replace(row, faults={kind: n for kind, n in sorted(scene.faults.items()) if n})
        problems += _left_behind(world.run, scene)
    return replace(row, problems=problems, seconds=round(time.monotonic() - started, 1))


def _judged(case: Case, row: Row, report: RunReport, scene: Scene, decided: Sequence[tuple[str, int]]) -> list[str]:
    """What the report tells that must not be so."""
    found = [f"the fault {kind!r} did not occur" for kind in case.needs if not scene.faults[kind]]
    if report.ending.exit_code != TERMINATED:
        found.append(f"the world ended with {report.ending.exit_code}: {report.ending.reason}")
    if row.heard_s is None or row.heard_s > case.heard_s:
        found.append(f"an agent was heard again after {row.heard_s} s, {case.heard_s:g} s are allowed")
    if not case.attack:
        return found
    if report.restarts:
        found.append(f"processes died: {report.restarts}")
    if row.pause_s > MAX_PAUSE:
        found.append(f"the run was held up for {row.pause_s} s")
    if row.secure:
        found += _changed(report, decided)
        if row.denied + row.refused == 0:
            found.append("the attack was not counted")
    return found


def _changed(report: RunReport, decided: Sequence[tuple[str, int]]) -> list[str]:
    """What an attack changed although there are certificates."""
    found = []
    if [(d.agent, d.action) for d in report.decisions][: len(decided)] != list(decided):
        found.append("the decisions are not those of a run that nobody attacked")
    if report.deaths:
        found.append(f"agents were lost: {report.deaths}")
    for agent in report.agents:
        heard = {kind: n for kind, n in agent.counts.items() if kind in ("unparsed", "other_epoch", "refused")}
        if heard:
            found.append(f"{agent.name} heard of it: {heard}")
    return found


def _cost(world: WorldOptions, objective: float, reached: float) -> float | None:
    """By how many percent the objective is worse; None where there is nothing to lose."""
    if objective == 0:
        return None
    worse = objective - reached if world.domain.better == "higher" else reached - objective
    return round(100 * worse / abs(objective), 2)


def _left_behind(run: str, scene: Scene) -> list[str]:
    """Processes, a port or private keys that are there after the end."""
    found = [f"process {pid} was left behind" for pid in processes_of(run)]
    certs = scene.deployment.certs
    if certs and Path(certs).exists():
        found.append(f"{certs} was left behind")
    try:
        for endpoint in split_endpoints(scene.deployment.endpoint):
            settle_port(endpoint)
    except MarlSchedError as error:
        found.append(str(error))
    return found


def campaign(
    world: WorldOptions,
    policy: str,
    folder: Path,
    chosen: Sequence[Case] = CASES,
    tell: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Play cases, attacks also without certificates; a row for each, which `tell` is told when it is there."""
    rows: list[Row] = []
    for case in chosen:
        for secure in (True, False) if case.attack else (True,):
            number = len(rows)
            protocol = "tls" if secure else "tcp"
            given = replace(world, run=f"{world.run}-{number}", listen=f"{protocol}/127.0.0.1:0", insecure=not secure)
            rows.append(run_case(case, given, policy, folder / f"{number:02}"))
            tell(rows[-1])
    return rows


def fuzz_row(count: int) -> Row:
    """As many payloads and keys that nobody would write, against the pure protocol."""
    started, problems = time.monotonic(), []
    counts = Counter[str]()
    try:
        counts = fuzz(count // 2)
    except Exception as error:  # whatever it is, it is what was looked for
        problems.append(f"{type(error).__name__}: {error}")
    seconds = round(time.monotonic() - started, 1)
    return Row(case="fuzzed keys and payloads", secure=True, faults=dict(counts), seconds=seconds, problems=problems)


def stops_row(count: int, world: WorldOptions, policy: str) -> Row:
    """As many deployments, each ended in another way or at another moment."""
    started = time.monotonic()
    problems = end_many(plan(count), replace(world, problem=world.problem.but(horizon=ENDLESS)), policy)
    seconds = round(time.monotonic() - started, 1)
    return Row(case="starts and stops", secure=True, faults={"ended": count}, seconds=seconds, problems=problems)


def table(rows: Sequence[Row]) -> str:
    """The rows as a table of Markdown, and what was wrong below it."""
    cells = [
        [
            f"{row.case}{'' if row.secure else ' (no certificates)'}",
            ", ".join(f"{kind} {n}" for kind, n in row.faults.items()),
            row.time or "",
            f"{row.pause_s:.2f}" if row.time else "",
            "" if row.heard_s is None else f"{row.heard_s:.2f}",
            "" if row.cost is None else f"{row.cost:.2f}",
            row.denied,
            row.refused,
            "FAILED" if row.problems else "held",
        ]
        for row in rows
    ]
    head = ["case", "what occurred", "time", "pause, s", "heard again, s", "cost, %", "denied", "refused", "invariants"]
    text = tabulate(cells, headers=head, tablefmt="pipe", disable_numparse=True)
    wrong = [f"- {row.case}: {problem}" for row in rows for problem in row.problems]
    return "\n".join([text, *(["", *wrong] if wrong else [])])


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    """The rows for a file."""
    failed = Counter(bool(row.problems) for row in rows)
    return {"schema": 1, "held": failed[False], "failed": failed[True], "cases": [asdict(row) for row in rows]}


def exit_code(rows: Sequence[Row]) -> int:
    """What a campaign ends with."""
    return int(ExitCode.DEFECT if any(row.problems for row in rows) else ExitCode.COMPLETE)

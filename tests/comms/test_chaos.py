"""The short campaign against real processes, and that a campaign notices what it is there to notice."""

from __future__ import annotations

import socket
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from marl_sched.comms.chaos.audit import reference, violations
from marl_sched.comms.chaos.campaign import Row, _judged, campaign, table
from marl_sched.comms.chaos.cases import CASES, Case
from marl_sched.comms.chaos.fuzz import fuzz
from marl_sched.comms.chaos.proxy import Link
from marl_sched.comms.chaos.stops import EXCEPTION, Stop, end_many
from marl_sched.comms.decision_log import FileLog, Header, Step, read_log
from marl_sched.comms.inproc import Threads
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import Commit
from marl_sched.comms.protocol.events import Outcome
from marl_sched.comms.transport.endpoints import check_endpoint
from marl_sched.comms.transport.faulty import Faults, FaultyTransport
from marl_sched.errors import InvalidOptionError
from marl_sched.problem import Problem

LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 12}


def problem(horizon: int | None = None) -> Problem:
    return Problem("airme", count=1, horizon=horizon, view=LOCAL)


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case.in_short], ids=lambda case: case.name)
def test_short_campaign_holds(tmp_path, case):
    world = WorldOptions(problem=problem(), run="chaos-test", deadline=30.0, ready_timeout=200.0, standstill=200.0)
    rows = campaign(world, "condition", tmp_path, [case])
    busy = [
        replace(row, problems=[p for p in row.problems if "held up" not in p and "s are allowed" not in p])
        for row in rows
    ]
    assert [row.problems for row in busy] == [[]] * len(rows), table(
        rows
    )  # how long things take is for `marl-sched chaos`


@pytest.mark.slow
def test_deployments_that_are_ended_leave_nothing_but_a_report(tmp_path):
    world = WorldOptions(problem=problem(10**6), run="chaos-test", ready_timeout=200.0)
    stops = [Stop(1, "starting", 0.2), Stop(2, "gathering", 0.0), Stop(EXCEPTION, "running", 0.0)]
    assert end_many(stops, world, "condition", str(tmp_path)) == []


def test_what_nobody_would_write_changes_nothing():
    counts = fuzz(3000, seed=7)
    assert counts["events"] == 6000
    assert counts["turns"] > 100  # somebody decided in between


# ---- the audit sees what it is there to see


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A run of two days: its options, its log and its report."""
    path = tmp_path_factory.mktemp("run") / "run.jsonl"
    world = WorldOptions(problem=problem(48))
    log = FileLog(path, Header.of(world))
    report = Threads(world, ["condition"] * 7, commits=log).play()
    log.close()
    return world, path, report


def rewritten(played, tmp_path: Path, change) -> list[str]:
    """What the audit finds in a log whose steps were changed."""
    world, path, report = played
    header, *steps = read_log(path)
    log = FileLog(tmp_path / "run.jsonl", header)
    for step in change(steps):
        log.append(step)
    log.close()
    return violations(world, tmp_path / "run.jsonl", b"", report)


def test_audit_has_nothing_against_a_run_that_nobody_disturbed(played):
    world, path, report = played
    assert violations(world, path, path.read_bytes()[:1000], report) == []
    decided, objective = reference(world, "condition", 48)
    assert decided == [(d.agent, d.action) for d in report.decisions]
    assert objective == report.M1


def test_audit_sees_a_lost_commit(played, tmp_path):
    world, path, report = played
    assert any("log no longer begins" in v for v in violations(world, path, path.read_bytes() + b"more", report))
    assert any("comes out otherwise" in v for v in rewritten(played, tmp_path, lambda steps: steps[:3] + steps[4:]))


def test_audit_sees_a_decision_that_was_applied_twice(played, tmp_path):
    def change(steps):
        twice = Step(commits=steps[5].commits, sources=steps[4].sources)
        return [*steps[:5], twice, *steps[6:]]

    assert any("was applied 2 times" in v for v in rewritten(played, tmp_path, change))


def test_audit_sees_two_owners_and_another_outcome(played, tmp_path):
    def change(steps):
        mine = Commit(tick=0, agent=0, action=3, outcome=Outcome.DECIDED, reward=0.0, share=1.0)
        theirs = Commit(tick=0, agent=1, action=3, outcome=Outcome.DECIDED, reward=0.0, share=1.0)
        return [Step(commits=[mine]), Step(commits=[theirs]), *steps[2:]]

    found = rewritten(played, tmp_path, change)
    assert "time 0: action 3 has the owners 0 and 1" in found
    assert any("comes out otherwise" in v for v in found)


def test_case_in_which_nothing_occurred_or_an_attack_changed_something_has_failed():
    case = Case(name="x", fault=lambda scene: None, needs=("loss",), attack=True)
    report = SimpleNamespace(
        ending=SimpleNamespace(exit_code=143, reason=None), restarts={"world": 1}, decisions=[], deaths=[],
        agents=[SimpleNamespace(name="crew_0", counts={"unparsed": 2, "heard": 9})],
    )  # fmt: skip
    row = Row(case="x", secure=True, heard_s=2.5, pause_s=1.5)
    found = _judged(case, row, report, SimpleNamespace(faults=Counter()), [("crew_0", 1)])
    expected = (
        "'loss' did not occur",
        "2.5 s, 2 s are allowed",
        "processes died",
        "held up for 1.5 s",
        "not those of a run that nobody attacked",
        "crew_0 heard of it: {'unparsed': 2}",
        "was not counted",
    )
    for what in expected:
        assert any(what in problem for problem in found), (what, found)


# ---- faults on the way


class Sent:
    """A transport that notes what is put."""

    def __init__(self) -> None:
        self.keys: list[str] = []

    def put(self, key: str, payload: bytes, *, control: bool = False) -> None:
        self.keys.append(key)

    def close(self) -> None:
        self.keys.append("closed")


def sent_over(seed: int, count: int, **faults: float) -> tuple[list[str], Counter]:
    inner = Sent()
    faulty = FaultyTransport(inner, Faults(seed=seed, **faults), 0)
    for i in range(count):
        faulty.put(str(i), b"")
    end = time.monotonic() + 30
    while len(inner.keys) < count - faulty.injected["loss"] + faulty.injected["duplicate"] and time.monotonic() < end:
        time.sleep(0.01)
    faulty.close()
    return inner.keys, faulty.injected


def test_faults_are_counted_and_the_same_for_the_same_seed():
    keys, injected = sent_over(3, 400, loss=0.25, duplicate=0.5)
    assert sent_over(3, 400, loss=0.25, duplicate=0.5) == (keys, injected)
    assert sent_over(4, 400, loss=0.25, duplicate=0.5)[0] != keys
    assert len(keys) == 400 - injected["loss"] + injected["duplicate"] + 1
    assert abs(injected["loss"] - 100) < 6 * (400 * 0.25 * 0.75) ** 0.5  # six standard deviations
    assert sorted(map(int, keys[:-1])) == list(map(int, keys[:-1]))  # nothing was reordered


def test_messages_that_are_held_back_are_overtaken_and_all_arrive():
    keys, injected = sent_over(3, 200, reorder=0.2)
    assert sorted(map(int, keys[:-1])) == list(range(200))
    assert keys[:-1] != sorted(keys[:-1], key=int)
    assert set(injected) == {"reorder"}
    keys, injected = sent_over(3, 50, delay=0.05)
    assert sorted(map(int, keys[:-1])) == list(range(50))
    assert injected == {"delay": 50}


def test_faults_that_cannot_be_are_refused():
    with pytest.raises(InvalidOptionError, match=r"faults: loss: expected a probability, got 1\.5"):
        WorldOptions(problem=problem(), faults={"loss": 1.5})
    with pytest.raises(InvalidOptionError, match="faults: unknown los"):
        WorldOptions(problem=problem(), faults={"los": 0.5})


def test_link_that_is_cut_holds_everything_back_and_lets_it_go_when_it_is_mended():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        link = Link(f"tcp/127.0.0.1:{server.getsockname()[1]}")
        try:
            with socket.create_connection(check_endpoint("x", link.endpoint)) as client, server.accept()[0] as served:
                client.sendall(b"one")
                assert served.recv(10) == b"one"
                link.cut()
                time.sleep(0.1)
                client.sendall(b"two")
                served.settimeout(0.3)
                with pytest.raises(TimeoutError):
                    served.recv(10)
                link.mend()
                served.settimeout(30)
                assert served.recv(10) == b"two"
                assert link.hit["held"] == 1
        finally:
            link.close()

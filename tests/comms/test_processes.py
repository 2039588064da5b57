"""The real thing: one process per crew, over Zenoh on the loopback interface."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from pathlib import Path
from typing import Any

import pytest

from marl_sched.comms.chaos.stops import processes_of, takes_signals
from marl_sched.comms.launcher import Deployment, deploy
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.process import print_progress
from marl_sched.errors import DeploymentError, UnknownNameError
from marl_sched.problem import Problem

LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 12}
AIRME = {"schema": 1, "env": "airme", "unit": "hours", "count": 1}
needs_proc = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes in /proc")


def world(*, horizon=48, **changes) -> WorldOptions:
    """Seven crews under a run's name of their own; nobody is late on a busy machine."""
    run = f"test-{uuid.uuid4().hex[:12]}"
    defaults = {
        "problem": Problem("airme", count=1, horizon=horizon, view=LOCAL), "run": run, "listen": "tls/127.0.0.1:0",
        "deadline": 30.0, "ready_timeout": 200.0, "standstill": 200.0, "grace": 60.0,
    }  # fmt: skip
    return WorldOptions(**{**defaults, **changes})


def wait_until(condition, seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"still not so after {seconds:g} s"
        time.sleep(0.05)


def run_module(name: str, options: dict, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", f"marl_sched.comms.{name}", json.dumps(options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


class At:
    """Does things once, when the run has come to a tick; a `progress` of Deployment.wait."""

    def __init__(self, *steps: tuple[int, Any]) -> None:
        self.steps, self.done = list(steps), []

    def __call__(self, phase: str, tick: int, horizon: int) -> None:
        while self.steps and phase in ("running", "standstill") and tick >= self.steps[0][0]:
            self.steps.pop(0)[1]()
            self.done.append(tick)


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize("learned", [False, True], ids=["rule", "learned"])
def test_processes_play_the_run_that_is_played_in_process(in_process, save_policy, tmp_path, learned):
    given = world(report=str(tmp_path / "run.json"))
    policies = [save_policy(1) if learned else "random"] * 6 + ["condition"]
    told = []
    report = deploy(
        DeployOptions(world=given, policy=policies[0], agent_policies={"crew_6": "condition"}),
        lambda *progress: told.append(progress),
    ).as_json()
    reference = in_process(given, policies)
    assert [agent["policy"] for agent in report["agents"]] == policies
    assert report["decisions"] == reference["decisions"]
    assert report["rewards"] == reference["rewards"]
    assert report["M1"] == reference["M1"]
    assert report["ending"] == {"kind": "complete", "reason": None, "exit_code": 0}
    assert set(report["exit_codes"].values()) == {0}
    assert json.loads((tmp_path / "run.json").read_text()) == report
    assert {phase for phase, _, _ in told} >= {"running"}
    assert processes_of(given.run) == []


@pytest.mark.slow
@needs_proc
def test_killed_agent_is_started_again_and_nothing_is_lost(in_process, tmp_path):
    given = world(horizon=3000)
    options = DeployOptions(world=given, policy="condition", folder=str(tmp_path / "kept"))
    with Deployment(options) as deployment:
        kill = At((20, lambda: deployment.signal("crew_3", signal.SIGKILL)))
        report = deployment.wait(kill).as_json()
    assert kill.done
    assert report["restarts"] == {"crew_3": 1}
    mine = [e["event"] for e in report["events"] if e["agent"] == "crew_3"]
    assert mine == ["joined", "gone", "joined"]
    assert report["decisions"] == in_process(given, ["condition"] * 7)["decisions"]
    assert (tmp_path / "kept" / "crew_3.log").exists()
    assert (tmp_path / "kept" / "run.jsonl").exists()
    assert processes_of(given.run) == []


def test_a_line_of_progress_is_one_write_also_where_python_does_not_buffer(monkeypatch):
    class Pipe(io.RawIOBase):
        def writable(self):
            return True

        def write(self, data):
            written.append(bytes(data))
            return len(data)

    written = []
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(Pipe(), write_through=True))
    print_progress("running", 3, 48)
    assert [data for data in written if data] == [b'{"phase": "running", "tick": 3, "horizon": 48}\n']


@pytest.mark.slow
@needs_proc
def test_agent_that_is_lost_is_said_in_report_and_exit_code():
    given = world(horizon=3000, grace=0.5)
    with Deployment(DeployOptions(world=given, policy="condition", restarts=0)) as deployment:
        report = deployment.wait(At((20, lambda: deployment.signal("crew_3", signal.SIGKILL)))).as_json()
    (death,) = report["deaths"]
    assert (death["agent"], death["event"]) == ("crew_3", "lost")
    assert report["ending"] == {"kind": "complete", "reason": None, "exit_code": 3}
    assert report["exit_codes"]["crew_3"] == -signal.SIGKILL
    assert report["time"] == given.problem.horizon
    later = [d for d in report["decisions"] if d["hour"] > death["hour"]]
    assert {d["outcome"] for d in later if d["agent"] == "crew_3"} == {"absent"}
    assert "absent" not in {d["outcome"] for d in later if d["agent"] != "crew_3"}


@pytest.mark.slow
@needs_proc
def test_world_that_is_killed_goes_on_from_its_log(in_process):
    given = world(horizon=3000)
    with Deployment(DeployOptions(world=given, policy="condition")) as deployment:
        kill = At((20, lambda: deployment.signal("world", signal.SIGKILL)))
        report = deployment.wait(kill).as_json()
    reference = in_process(given, ["condition"] * 7)
    assert kill.done
    assert report["restarts"]["world"] == 1
    assert report["decisions"] == reference["decisions"]
    assert report["rewards"] == reference["rewards"]
    assert {name: code for name, code in report["exit_codes"].items() if code} == {}


@pytest.mark.slow
@needs_proc
def test_world_that_is_frozen_for_a_while_loses_nobody(in_process):
    given = world(horizon=3000)
    with Deployment(DeployOptions(world=given, policy="condition")) as deployment:

        def freeze() -> None:
            deployment.signal("world", signal.SIGSTOP)
            time.sleep(3.0)
            deployment.signal("world", signal.SIGCONT)

        report = deployment.wait(At((20, freeze))).as_json()
    assert report["deaths"] == []
    assert report["slept_s"] > 1.0
    assert report["decisions"] == in_process(given, ["condition"] * 7)["decisions"]


@pytest.mark.slow
@needs_proc
def test_frozen_agent_is_given_up_and_comes_back_as_another_incarnation():
    given = world(horizon=2000, deadline=0.5, grace=0.5)
    with Deployment(DeployOptions(world=given, policy="condition")) as deployment:
        report = deployment.wait(
            At(
                (20, lambda: deployment.signal("crew_3", signal.SIGSTOP)),
                (200, lambda: deployment.signal("crew_3", signal.SIGCONT)),  # no repair is that long: its turn has come
            )
        ).as_json()
    mine = [e["event"] for e in report["events"] if e["agent"] == "crew_3" and e["event"] not in ("late", "gone")]
    assert mine[0] == mine[-1] == "joined"
    assert set(mine[1:-1]) <= {"lost", "silent", "unheard", "returned"}
    assert report["exit_codes"]["crew_3"] == 0


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
@pytest.mark.parametrize("at", ["begun", "starting", "running"])
def test_launcher_that_is_ended_leaves_a_report_and_no_process_or_folder(tmp_path, number, at):
    given = world(horizon=10**6)
    code = (
        "import sys\n"
        "from marl_sched.comms.launcher import deploy\n"
        "from marl_sched.comms.options import DeployOptions, WorldOptions\n"
        "from marl_sched.comms.process import parse_options\n"
        "print('begun', flush=True)\n"
        "def progress(phase, tick, horizon):\n    print(phase, flush=True)\n"
        "deploy(DeployOptions(world=parse_options(sys.argv[1], WorldOptions), policy='condition'), progress)\n"
    )
    report, temporary = tmp_path / "report.json", tmp_path / "tmp"
    temporary.mkdir()
    options = json.dumps({**given.as_json(), "report": str(report)})
    launcher = subprocess.Popen(
        [sys.executable, "-P", "-c", code, options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(temporary)},
    )  # fmt: skip
    try:
        line = ""
        while line != f"{at}\n":
            line = launcher.stdout.readline()
            assert line, launcher.stderr.read()
        wait_until(lambda: takes_signals(launcher.pid))  # they are its first act; a signal before them is Python's
        launcher.send_signal(number)
        _, errors = launcher.communicate(timeout=120)
        wait_until(lambda: processes_of(given.run) == [], 60)
    finally:
        launcher.kill()
        launcher.wait()
        for pid in processes_of(given.run):
            os.kill(pid, signal.SIGKILL)
    if number != signal.SIGKILL:
        assert launcher.returncode == 128 + number
        assert "Traceback" not in errors
        assert json.loads(report.read_text())["ending"]["kind"] == "interrupted"
        assert list(temporary.iterdir()) == []


@pytest.mark.slow
@needs_proc
def test_error_of_an_agent_before_the_run_ends_all_processes_and_names_it(tmp_path):
    broken = tmp_path / "policy.safetensors"
    broken.write_bytes(b"no weights")
    given = world(report=str(tmp_path / "report.json"))
    with pytest.raises(DeploymentError, match=r"policy\.safetensors|policy\.json"):
        deploy(DeployOptions(world=given, policy="condition", agent_policies={"crew_2": str(broken)}))
    assert json.loads((tmp_path / "report.json").read_text())["ending"]["kind"] == "failed"
    assert processes_of(given.run) == []


@pytest.mark.slow
@needs_proc
def test_part_of_the_team_is_started_here_and_the_rest_elsewhere():
    given = world(horizon=10, ready_timeout=2.0)
    options = DeployOptions(world=given, policy="condition", agents=("crew_0", "crew_2"))
    with pytest.raises(DeploymentError, match=r"not there within 2 s: crew_1, crew_3, crew_4, crew_5, crew_6"):
        deploy(options)


def test_unknown_policy_and_agent_are_refused_before_anything_starts():
    with pytest.raises(UnknownNameError, match="unknown scheduler 'conditionn'; did you mean 'condition'"):
        Deployment(DeployOptions(world=world(), policy="conditionn"))
    with pytest.raises(UnknownNameError, match=r"'crew_9'.*Known: crew_0, .*crew_6"):
        Deployment(DeployOptions(world=world(), policy="random", agent_policies={"crew_9": "random"}))
    with pytest.raises(UnknownNameError, match="'crew_9'"):
        Deployment(DeployOptions(world=world(), policy="random", agents=("crew_9",)))


@pytest.mark.slow
def test_port_in_use_is_one_line_and_exit_code_2():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = run_module("world", {"problem": AIRME, "listen": endpoint})
    assert done.returncode == 2
    assert done.stderr == f"error: cannot listen on {endpoint}: Address already in use\n"
    assert done.stdout == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("agent", {"agent": 0, "policy": "condition", "connect": "tcp/127.0.0.1:1", "join_timeout": 0.5}, "no world"),
        ("agent", {"agent": -1, "policy": "condition"}, "agent: expected an index >= 0, got -1"),
        ("agent", {"agent": "x", "policy": "condition"}, "Expected `int`, got `str` - at `$.agent`"),
        ("world", {"problem": AIRME, "huors": 3}, "unknown huors"),
        ("world", {"problem": {**AIRME, "env": "airmee"}}, "did you mean 'airme'"),
        ("world", {"problem": {**AIRME, "scale": "tiny"}}, "unknown scale of airme 'tiny'"),
        ("world", {"problem": {**AIRME, "view": "locall"}}, "did you mean 'local'"),
        ("world", {"problem": {**AIRME, "view": {"kind": "full", "reach": 1}}}, "reach"),
        ("world", {"problem": AIRME, "listen": "127.0.0.1:7447"}, "expected an endpoint such as tcp/127.0.0.1:7447"),
        ("world", {"problem": AIRME, "deadline": 0}, "deadline: expected a number > 0"),
        ("world", {"problem": AIRME, "clock": "fast"}, "Invalid enum value 'fast'"),
    ],
)
def test_wrong_options_are_one_line_and_exit_code_2(name, options, message):
    done = run_module(name, options)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


IMPORTS = """
import sys
import marl_sched.comms.{module}
from marl_sched.comms.options import WorldOptions
from marl_sched.problem import Problem
WorldOptions(problem=Problem("airme", count=1)).simulator()
loaded = sorted(name for name in sys.modules if name.split(".")[0] in {{"torch", "tensordict"}})
print(loaded + sorted(name for name in sys.modules if name.startswith(("marl_sched.agents", "marl_sched.train"))))
"""


def test_world_imports_neither_torch_nor_anything_that_decides():
    code = IMPORTS.format(module="world")
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True, timeout=240)
    assert done.stdout == "[]\n"


def test_agent_that_follows_a_rule_does_not_import_torch():
    code = IMPORTS.format(module="agent") + (
        "from marl_sched.agents.registry import create_scheduler\n"
        "create_scheduler('condition', 'airme')\n"
        "print('torch' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True, timeout=240)
    assert done.stdout.endswith("False\n")


def test_protocol_imports_neither_clock_thread_socket_nor_network():
    forbidden = {"time", "threading", "socket", "zenoh", "asyncio", "selectors", "datetime", "random"}
    from marl_sched.comms import membership, protocol

    for package in (protocol, membership):
        for path in Path(package.__file__).parent.glob("*.py"):
            imported = {
                line.split()[1].split(".")[0]
                for line in path.read_text().splitlines()
                if line.startswith(("import ", "from "))
            }
            assert not imported & forbidden, path

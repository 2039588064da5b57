"""The real thing: one process per crew, over Zenoh on the loopback interface."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from marl_sched.comms.launcher import Deployment, deploy
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.errors import UnknownNameError

LOCAL = {"view": "local", "view_options": {"reach": 1, "comm": 1, "staleness": 12}}
needs_proc = pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="looks for processes in /proc")


def world(**changes) -> WorldOptions:
    """Seven crews under a run's name of their own; nobody is late on a busy machine."""
    run = f"test-{uuid.uuid4().hex[:12]}"
    defaults = {"seed": 0, "hours": 48, "run": run, "listen": "tcp/127.0.0.1:0", "deadline": 30.0, **LOCAL}
    return WorldOptions(**{**defaults, **changes})


def processes_of(run: str) -> list[int]:
    """Processes that have the run's name on their command line."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:  # it has just ended
                continue
            if run.encode() in command:
                found.append(int(entry.name))
    return found


def wait_until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"still not so after {seconds:g} s"
        time.sleep(0.05)


def run_module(name: str, options: dict, timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", f"marl_sched.comms.{name}", json.dumps(options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


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
    )
    reference = in_process(given, policies)
    assert [agent["policy"] for agent in report["agents"]] == policies
    assert report["decisions"] == reference["decisions"]
    assert report["rewards"] == reference["rewards"]
    assert report["M1"] == reference["M1"]
    assert report["deaths"] == []
    assert set(report["exit_codes"].values()) == {0}
    assert json.loads((tmp_path / "run.json").read_text()) == report
    assert {phase for phase, _, _ in told} >= {"running"}
    assert processes_of(given.run) == []


@pytest.mark.slow
@needs_proc
def test_others_go_on_when_an_agent_is_killed_and_the_report_says_so():
    given = world(hours=400)
    killed = []
    with Deployment(DeployOptions(world=given, policy="condition")) as deployment:

        def kill_in_the_middle(phase: str, moment: int, horizon: int) -> None:
            if phase == "running" and moment >= 20 and not killed:
                deployment.children["crew_3"].process.kill()
                killed.append(moment)

        report = deployment.wait(kill_in_the_middle)
    (death,) = report["deaths"]
    assert (death["agent"], death["event"]) == ("crew_3", "gone")
    assert killed[0] <= death["hour"] < given.hours
    assert death["waited_s"] < 5.0  # far less than the deadline: the liveliness token ends the wait
    assert report["hours"] == given.hours
    assert report["exit_codes"]["crew_3"] == -signal.SIGKILL
    later = [d for d in report["decisions"] if d["hour"] > death["hour"]]
    assert {d["outcome"] for d in later if d["agent"] == "crew_3"} == {"absent"}
    assert {d["agent"] for d in later} == {f"crew_{i}" for i in range(7)}
    assert "absent" not in {d["outcome"] for d in later if d["agent"] != "crew_3"}
    assert processes_of(given.run) == []


@pytest.mark.slow
@needs_proc
def test_frozen_agent_is_given_up_and_comes_back_as_another_incarnation():
    given = world(hours=1000, deadline=0.5)
    frozen, thawed = [], []
    with Deployment(DeployOptions(world=given, policy="condition")) as deployment:

        def freeze_then_thaw(phase: str, moment: int, horizon: int) -> None:
            process = deployment.children["crew_3"].process
            if phase == "running" and moment >= 20 and not frozen:
                process.send_signal(signal.SIGSTOP)
                frozen.append(moment)
            elif frozen and not thawed and moment >= frozen[0] + 100:  # no repair is that long: its turn has come
                process.send_signal(signal.SIGCONT)
                thawed.append(moment)

        report = deployment.wait(freeze_then_thaw)
    mine = [e for e in report["events"] if e["agent"] == "crew_3" and e["event"] != "late"]
    events = [e["event"] for e in mine]
    assert events in (["joined", "gone", "joined"], ["joined", "silent", "joined"]), (report["exit_codes"], thawed)
    assert mine[1]["waited_s"] <= report["delay_bound_s"] + 0.5
    assert report["exit_codes"]["crew_3"] == 0


@pytest.mark.slow
@needs_proc
def test_agents_outlive_their_world_and_serve_its_successor(in_process):
    given = world(hours=300)
    with Deployment(DeployOptions(world=given, policy="condition")) as deployment:
        wait_until(lambda: deployment.moment >= 10)
        deployment.children["world"].process.kill()
        deployment.children["world"].process.wait()
        deployment.start_world()
        report = deployment.wait()
    reference = in_process(given, ["condition"] * 7)
    assert report["decisions"] == reference["decisions"]
    assert report["rewards"] == reference["rewards"]
    assert set(report["exit_codes"].values()) == {0}


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_is_left_when_the_launcher_is_ended(number):
    given = world(hours=10**6)
    code = (
        "import json, sys\n"
        "from marl_sched.comms.launcher import deploy\n"
        "from marl_sched.comms.options import DeployOptions, WorldOptions\n"
        "deploy(DeployOptions(world=WorldOptions(**json.loads(sys.argv[1])), policy='condition'))\n"
    )
    options = json.dumps({**{name: getattr(given, name) for name in ("seed", "hours", "run", "listen")}, **LOCAL})
    launcher = subprocess.Popen([sys.executable, "-P", "-c", code, options], stderr=subprocess.DEVNULL)
    try:
        wait_until(lambda: len(processes_of(given.run)) == 9)  # itself, the world, seven crews
        time.sleep(1.0)  # let some of them come so far as to have a session
        launcher.send_signal(number)
        launcher.wait(timeout=30)
        wait_until(lambda: processes_of(given.run) == [], 15)
    finally:
        launcher.kill()
        launcher.wait()
        for pid in processes_of(given.run):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
@needs_proc
def test_error_of_an_agent_ends_all_processes_and_names_it(tmp_path):
    broken = tmp_path / "policy.safetensors"
    broken.write_bytes(b"no weights")
    code = (
        "import sys\n"
        "from marl_sched.comms.launcher import deploy\n"
        "from marl_sched.comms.options import DeployOptions, WorldOptions\n"
        "from marl_sched.errors import DeploymentError\n"
        "options = DeployOptions(world=WorldOptions(run=sys.argv[1], listen='tcp/127.0.0.1:0'),\n"
        "                        agent_policies={'crew_2': sys.argv[2]})\n"
        "try:\n    deploy(options)\nexcept DeploymentError as error:\n    print(error)\n"
    )
    run = world().run
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, run, str(broken)], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.startswith("crew_2 ended with 2 before the run began: ")
    assert str(tmp_path) in done.stdout
    assert done.stdout.count("\n") == 1
    assert processes_of(run) == []


def test_unknown_policy_and_agent_are_refused_before_anything_starts():
    with pytest.raises(UnknownNameError, match="unknown scheduler 'conditoin'; did you mean 'condition'"):
        Deployment(DeployOptions(world=world(), policy="conditoin"))
    with pytest.raises(UnknownNameError, match=r"'crew_9'.*Known: crew_0, .*crew_6"):
        Deployment(DeployOptions(world=world(), agent_policies={"crew_9": "random"}))


@pytest.mark.slow
def test_port_in_use_is_one_line_and_exit_code_2():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = run_module("world", {"listen": endpoint})
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
        ("world", {"huors": 3}, "unknown huors"),
        ("world", {"env": "airmee"}, "did you mean 'airme'"),
        ("world", {"scale": "tiny"}, "unknown scale of airme 'tiny'"),
        ("world", {"view": "lokal"}, "did you mean 'local'"),
        ("world", {"view": "full", "view_options": {"reach": 1}}, "reach"),
        ("world", {"listen": "127.0.0.1:7447"}, "expected an endpoint such as tcp/127.0.0.1:7447"),
        ("world", {"deadline": 0}, "deadline: expected a number > 0"),
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
WorldOptions(seed=0).simulator()
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

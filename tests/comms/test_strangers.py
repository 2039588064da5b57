"""Strangers on the network of a real deployment, without certificates: nothing crashes, nobody is delayed for long."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import uuid

import pytest

from marl_sched.comms.launcher import Deployment
from marl_sched.comms.options import DeployOptions, WorldOptions

LOCAL = {"view": "local", "view_options": {"reach": 1, "comm": 1, "staleness": 12}}

# A client of the run with Zenoh's own defaults, as a dashboard or an intruder would be: endpoint, run, what to do.
STRANGER = """
import json, sys, time, zenoh
endpoint, run, what = sys.argv[1:]
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}))
session = zenoh.open(config)
root = f"marl_sched/{run}/"
if what == "listen":
    session.declare_subscriber("**", lambda sample: None)
    print("ready", flush=True)
    time.sleep(600)
print("ready", flush=True)
forged = {"type": "clock.2", "run": run, "epoch": "x", "tick": 1, "phase": "over"}
end, count = time.monotonic() + 5.0, 0
while time.monotonic() < end:
    for key in ("crew/3/decision", "crew/3/hello", f"crew/{'9' * 5000}/decision", f"crew/{count}/decision",
                "world/clock", "crew/3/turn", "plane/3/now"):
        session.put(root + key, json.dumps(forged).encode() + bytes(200))
        count += 1
    token = session.liveliness().declare_token(root + f"crew/3/alive/forged-{count}")
    list(session.get(root + "world/snapshot/3", payload=b"garbage", timeout=0.01)) if count % 70 == 0 else None
    token.undeclare()
print(count, flush=True)
session.close()
"""


def world() -> WorldOptions:
    run = f"test-{uuid.uuid4().hex[:12]}"
    return WorldOptions(
        env="airme", seed=0, horizon=4000, run=run, listen="tcp/127.0.0.1:0", insecure=True, deadline=30.0,
        ready_timeout=200.0, standstill=200.0, grace=60.0, **LOCAL,
    )  # fmt: skip


def stranger(deployment: Deployment, what: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", "-c", STRANGER, deployment.endpoint, deployment.options.world.run, what]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


def played_with(what: str, then) -> tuple[dict, WorldOptions, subprocess.Popen[str]]:
    """A deployment's report, with a stranger that comes when it runs."""
    given, strangers = world(), []
    with Deployment(DeployOptions(world=given, policy="condition", restarts=0)) as deployment:

        def progress(phase: str, tick: int, horizon: int) -> None:
            if phase == "running" and tick >= 20 and not strangers:
                strangers.append(stranger(deployment, what))
                then(strangers[0])

        try:
            report = deployment.wait(progress)
        finally:
            for process in strangers:
                process.kill()
    return report, given, strangers[0]


@pytest.mark.slow
def test_bystander_that_freezes_changes_nothing(in_process):
    report, given, _ = played_with("listen", lambda process: process.send_signal(signal.SIGSTOP))
    assert report["ending"]["exit_code"] == 0, json.dumps(report["events"])
    assert report["decisions"] == in_process(given, ["condition"] * 7)["decisions"]
    assert report["deaths"] == []


@pytest.mark.slow
def test_flood_of_garbage_and_forgeries_is_counted_and_changes_nothing(in_process):
    report, given, _ = played_with("flood", lambda process: None)
    assert report["ending"]["exit_code"] == 0, json.dumps(report["events"])
    assert report["decisions"] == in_process(given, ["condition"] * 7)["decisions"]
    assert report["unparsed"] > 0
    assert report["deaths"] == []

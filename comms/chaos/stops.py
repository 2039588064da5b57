"""Deployments that are ended in every way and at every moment: nothing may be left but a report."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marl_sched.comms.options import WorldOptions
from marl_sched.comms.process import SIGNALS
from marl_sched.comms.transport.endpoints import settle_port
from marl_sched.errors import DeploymentError

EXCEPTION = 0  # in place of a signal: the caller's own code raises
MOMENTS = ("begun", "starting", "gathering", "running")  # reached when the deployment says so
PATIENCE = 240.0
# A program that deploys, as a user would write one; it says how far it has come.
PROGRAM = """
import json, sys
from marl_sched.comms.launcher import deploy
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.process import parse_options
world, policy, raises_at = json.loads(sys.argv[1])
print("begun", flush=True)
class CallersOwn(Exception):
    pass
def progress(phase, tick, horizon):
    print(phase, flush=True)
    if phase == raises_at:
        raise CallersOwn
try:
    deploy(DeployOptions(world=parse_options(json.dumps(world), WorldOptions), policy=policy), progress)
except CallersOwn:
    pass
"""


@dataclass(frozen=True)
class Stop:
    """How and when a deployment is ended: by a signal (or EXCEPTION), so many seconds after a moment."""

    number: int
    moment: str
    after: float


def plan(count: int, seed: int = 0) -> list[Stop]:
    """Ends by every signal and by an exception, at every moment, with a random delay."""
    random = np.random.default_rng(seed)
    ways = [*SIGNALS, EXCEPTION]
    stops = []
    for i in range(count):
        number, moment = ways[i % len(ways)], MOMENTS[i // len(ways) % len(MOMENTS)]
        if number == EXCEPTION and moment == "begun":
            moment = "running"  # before it is told of any progress a caller can raise nothing
        stops.append(Stop(int(number), moment, float(random.uniform(0.0, 0.5))))
    return stops


def end_one(stop: Stop, world: WorldOptions, policy: str, folder: Path) -> list[str]:
    """Start a deployment, end it, and say what was left behind or missing, a sentence each."""
    temporary, report = folder / "tmp", folder / "report.json"
    temporary.mkdir(parents=True)
    endpoint = settle_port("tls/127.0.0.1:0")
    given = replace(world, listen=endpoint, report=str(report)).as_json()
    raises_at = stop.moment if stop.number == EXCEPTION else ""
    launcher = subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM, json.dumps([given, policy, raises_at])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    try:
        if stop.number != EXCEPTION:
            _reach(launcher, stop)
            launcher.send_signal(stop.number)
        _, errors = launcher.communicate(timeout=PATIENCE)
    finally:
        launcher.kill()
        launcher.wait()
    return _found(stop, launcher.returncode, errors, report, temporary, world.run, endpoint)


def _reach(launcher: subprocess.Popen[str], stop: Stop) -> None:
    """Wait until a deployment has come to a moment and takes signals; before that they are Python's."""
    line = ""
    while launcher.stdout is not None and line != f"{stop.moment}\n":
        line = launcher.stdout.readline()
        if not line:
            raise DeploymentError(f"a deployment that was to be ended when {stop.moment} ended before")
    end = time.monotonic() + PATIENCE
    while not takes_signals(launcher.pid) and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(stop.after)


def takes_signals(pid: int) -> bool:
    """Whether a process has a handler of its own for each of SIGNALS."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    (mask,) = re.findall(r"^SigCgt:\s*([0-9a-f]+)$", status, re.MULTILINE)
    return all(int(mask, 16) >> (number - 1) & 1 for number in SIGNALS)


def _found(stop: Stop, code: int, errors: str, report: Path, temporary: Path, run: str, endpoint: str) -> list[str]:
    how = f"{signal.Signals(stop.number).name if stop.number else 'exception'} when {stop.moment}"
    found = []
    if code != (128 + stop.number if stop.number else 0):
        found.append(f"{how}: exit code {code}")
    if "Traceback" in errors:
        found.append(f"{how}: a traceback: {errors.strip().splitlines()[-1]}")
    if not report.exists():
        found.append(f"{how}: no report")
    end = time.monotonic() + 10.0
    while processes_of(run) and time.monotonic() < end:
        time.sleep(0.05)
    found += [f"{how}: process {pid} was left" for pid in processes_of(run)]
    found += [f"{how}: {path.name} was left" for path in temporary.iterdir()]
    try:
        settle_port(endpoint)
    except DeploymentError as error:
        found.append(f"{how}: {error}")
    return found


def processes_of(run: str) -> list[int]:
    """Processes whose command line names a run: the fork server's stands for all that were forked from it."""
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


def end_many(stops: list[Stop], world: WorldOptions, policy: str, folder: str | None = None) -> list[str]:
    """What was left behind or missing after all of them; each deployment has a run of its own."""
    found = []
    with tempfile.TemporaryDirectory(prefix="marl_sched-stops-", dir=folder) as inside:
        for number, stop in enumerate(stops):
            given = replace(world, run=f"{world.run}-stop-{number}")
            found += end_one(stop, given, policy, Path(inside) / str(number))
    return found

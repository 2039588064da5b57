"""Starts a world and all its agents as processes on this machine, watches over them, and leaves none behind.

Processes are spawned, never forked: a forked Zenoh session sends nothing. Every child holds the other end of a pipe
to this process and ends when it breaks, so that none is left even if this process is killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from marl_sched.agents.registry import create_scheduler, scheduler_names
from marl_sched.comms.options import AgentOptions, DeployOptions
from marl_sched.comms.report import absent
from marl_sched.comms.session import settle_port
from marl_sched.domain import Domain
from marl_sched.errors import DeploymentError
from marl_sched.files import read_json, write_json

WORLD = "world"
POLL = 0.05  # seconds between two looks at the children
LEAVE = 15.0  # seconds that agents have to leave when the run is over
GRACE = 2.0  # seconds that a child has to end when asked to, before it is killed
Progress = Callable[[str, int, int], None]  # (phase, simulated time, horizon)


@dataclass
class Child:
    """A process that was started here."""

    name: str
    process: subprocess.Popen[str]
    errors: Path  # what it writes to stderr

    def complaint(self) -> str:
        """The last line that it wrote to stderr."""
        lines = self.errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1].removeprefix("error: ") if lines else "it said nothing"


class Deployment:
    """A running world with its agents; use it as a context manager, which ends all processes.

    Attributes:
        children: "world" or an agent's name -> its process.
        phase, moment, horizon: the world's progress, as it last said.
    """

    def __init__(self, options: DeployOptions) -> None:
        self.options = options
        simulator = options.world.simulator()
        self.policies = options.policies(int(simulator.n_agents[0]))
        for policy in sorted(set(self.policies)):
            _check_policy(policy, options.world.domain())
        warm_up(options)
        self.endpoint = settle_port(options.world.listen)
        self.children: dict[str, Child] = {}
        self.phase, self.moment, self.horizon = "starting", 0, options.world.hours

    def __enter__(self) -> Deployment:
        """Start all processes."""
        self._folder = tempfile.TemporaryDirectory(prefix="marl_sched-")
        self._report = Path(self._folder.name) / "report.json"
        try:
            self.start_world()
            for agent in range(len(self.policies)):
                self.start_agent(agent)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        """End all processes."""
        self.close()

    def start_world(self) -> None:
        """Start the world's process; again, if it has died, and then the run begins anew with the same agents."""
        self.phase, self.moment = "starting", 0
        options = replace(self.options.world, listen=self.endpoint, report=str(self._report))
        self._start(WORLD, "marl_sched.comms.world", asdict(options))
        lines = self.children[WORLD].process.stdout
        threading.Thread(target=self._follow, args=(lines,), daemon=True).start()

    def start_agent(self, agent: int) -> None:
        """Start an agent's process; again, if it has died."""
        options = AgentOptions(
            agent=agent,
            policy=self.policies[agent],
            run=self.options.world.run,
            connect=self.endpoint,
            join_timeout=self.options.world.ready_timeout,
        )
        name = self.options.world.domain().agent_name(agent)
        self._start(name, "marl_sched.comms.agent", asdict(options))

    def _start(self, name: str, module: str, options: dict[str, Any]) -> None:
        errors = Path(self._folder.name) / f"{name}.{time.monotonic_ns()}.stderr"
        with errors.open("w") as stderr:
            process = subprocess.Popen(
                [sys.executable, "-m", module, json.dumps(options), "--supervised"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if name == WORLD else subprocess.DEVNULL,
                stderr=stderr,
                text=True,
                env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C reaches this process alone, which then ends the others
            )
        self.children[name] = Child(name, process, errors)

    def _follow(self, lines: Any) -> None:
        for line in lines:
            said = json.loads(line)
            self.phase, self.moment, self.horizon = said["phase"], said["moment"], said["horizon"]

    def wait(self, progress: Progress | None = None) -> dict[str, Any]:
        """Wait for the end of the run; its report.

        Raises DeploymentError if the world fails, or an agent does before the run has begun; one that dies later
        is in the report.
        """
        world = self.children[WORLD].process
        shown = ("", -1)
        while world.poll() is None:
            if progress is not None and shown != (self.phase, self.moment):
                shown = (self.phase, self.moment)
                progress(self.phase, self.moment, self.horizon)
            if self.phase in ("starting", "gathering"):
                self._check_agents()
            try:
                world.wait(POLL)
            except subprocess.TimeoutExpired:
                continue
        if world.returncode != 0:
            raise DeploymentError(f"the world ended with {world.returncode}: {self.children[WORLD].complaint()}")
        report: dict[str, Any] = read_json(self._report)
        end = time.monotonic() + LEAVE
        for name, child in self.children.items():
            if name not in absent(report["events"]):
                _wait(child.process, end)
        report["exit_codes"] = {name: child.process.poll() for name, child in self.children.items()}
        return report

    def _check_agents(self) -> None:
        for name, child in self.children.items():
            code = child.process.poll()
            if name != WORLD and code is not None:
                raise DeploymentError(f"{name} ended with {code} before the run began: {child.complaint()}")

    def close(self) -> None:
        """End all processes: ask, wait GRACE seconds, kill."""
        processes = [child.process for child in self.children.values()]
        for process in processes:
            if process.poll() is None:
                process.terminate()
        end = time.monotonic() + GRACE
        for process in processes:
            if not _wait(process, end):
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
        self._folder.cleanup()


def deploy(options: DeployOptions, progress: Progress | None = None) -> dict[str, Any]:
    """Play one run with every agent as a process of its own; the report, with the seconds it took in all.

    It is also written to `options.world.report` if that is set. Raises UnknownNameError, InvalidOptionError and
    InvalidFileError for what cannot be deployed, DeploymentError naming the process that failed. On SIGTERM and
    Ctrl-C all processes are ended first.
    """
    started = time.monotonic()
    with _sigterm_as_exit(), Deployment(options) as deployment:
        report = deployment.wait(progress)
    report["seconds_in_all"] = round(time.monotonic() - started, 3)
    if options.world.report:
        write_json(options.world.report, report)
    return report


def _check_policy(policy: str, domain: Domain) -> None:
    """Raise what an agent would say of a policy that does not exist, without loading one that does."""
    if policy not in scheduler_names(domain.name) and not Path(policy).exists():
        create_scheduler(policy, domain)


def warm_up(options: DeployOptions) -> None:
    """Compile, once and to Numba's cache on disk, what all the processes are about to use."""
    telemetry, simulator = options.world.telemetry(), options.world.simulator()
    local_state = telemetry.local_state(telemetry.frame(simulator), 0)
    for channel, payload in telemetry.messages(simulator).items():
        if channel in local_state.channels:
            local_state.hear(channel, payload)
    local_state.observe()
    simulator.observe(simulator.acting)
    simulator.policy_noise(simulator.acting)
    simulator.step(np.zeros(1, np.int64))


def _wait(process: subprocess.Popen[str], end: float) -> bool:
    try:
        process.wait(max(end - time.monotonic(), 0.0))
    except subprocess.TimeoutExpired:
        return False
    return True


@contextmanager
def _sigterm_as_exit() -> Iterator[None]:
    """Let SIGTERM unwind the stack, so that context managers end the processes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)

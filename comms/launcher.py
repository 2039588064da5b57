"""Starts a world and its agents as processes on this machine, watches over them, and leaves none behind.

The processes are forked from a fork server that has imported everything. A process that dies is started again, with
growing delays and a limit; a world goes on from its log. If this process ends, in whatever way, all others do.
"""

from __future__ import annotations

import queue
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from signal import SIGTERM
from typing import Any

from msgspec import structs

from marl_sched.agents.light import create_light_scheduler
from marl_sched.agents.registry import create_scheduler, scheduler_names
from marl_sched.comms.agent_options import AgentOptions
from marl_sched.comms.children import BEING_STARTED, LEAVE, Child, ForkServerClient, Said
from marl_sched.comms.metrics.report import SCHEMA, RunReport
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.protocol.events import Ending, ExitCode
from marl_sched.comms.security.certificates import make_certificates
from marl_sched.comms.security.identity import ROUTER, WORLD, Identity
from marl_sched.comms.stop_signals import stop_signals
from marl_sched.comms.transport.endpoints import is_encrypted, settle_port
from marl_sched.domain import Domain
from marl_sched.errors import DeploymentError
from marl_sched.files import read_json, write_json
from marl_sched.light import Runtime, light_domain

POLL = 0.05  # seconds between two looks at the processes
FIRST_DELAY, LAST_DELAY, STEADY = 0.1, 5.0, 30.0  # seconds: until a restart, at most, and alive until that is forgotten
AGENT = "agent"  # the role of all processes but the world's
Progress = Callable[[str, int, int], None]  # (phase, how much of the horizon has passed, horizon)


class Deployment:
    """A running world with its agents; use it as a context manager, which ends all processes.

    Attributes:
        children: "world", "router_<i>" or an agent's name -> its process.
        phase, tick, horizon: the world's progress, as it last said.
        folder: where the logs, the run's log and the report are.
        certs: the folder of certificates, "" without; one of the run's own exists while it lasts.
        routers: endpoints of the run's routers, none in a star.
        routes: agent -> the endpoint by which it reaches the world, if not the world's own.
    """

    def __init__(self, options: DeployOptions) -> None:
        self.options = options
        options.world.telemetry()
        self._n_agents = options.world.plant().n_agents
        self.policies = options.policies(self._n_agents)
        self.started_here = options.started_here(self._n_agents)
        for policy in sorted(set(self.policies)):
            _check_policy(policy, options.world.domain, options.runtime)
        self.routers = tuple(map(settle_port, options.world.routers))
        self.endpoint = ",".join(self.routers) or settle_port(options.world.listen)
        self.certs, self.routes = options.world.certs, dict[int, str]()
        if self.certs:
            self._check_certificates(Path(self.certs))
        self.children: dict[str, Child] = {}
        self.phase, self.tick, self.horizon = "starting", 0, options.world.problem.horizon
        self._said: queue.SimpleQueue[Said] = queue.SimpleQueue()
        self._servers: dict[str, ForkServerClient] = {}  # by role
        self._kept, self._own_certs = bool(options.folder), ""

    def __enter__(self) -> Deployment:
        """Start all processes."""
        if self.options.folder:
            self.folder = Path(self.options.folder)
            self.folder.mkdir(parents=True, exist_ok=True)
        else:
            self.folder = Path(tempfile.mkdtemp(prefix="marl_sched-"))
        self.report_path = self.folder / "report.json"
        try:
            if is_encrypted(self.endpoint) and not self.certs:
                self.certs = self._own_certs = tempfile.mkdtemp(prefix="marl_sched-certs-")
                make_certificates(Path(self.certs), [self._name(agent) for agent in range(self._n_agents)])
            self._start_servers()
            for number, endpoint in enumerate(self.routers):
                self._add(f"{ROUTER}_{number}", lambda at=endpoint: self._start_router(at))  # type: ignore[misc]  # a bound default
            self._add(WORLD, self.start_world)
            for agent in self.started_here:
                self._add(self._name(agent), lambda agent=agent: self.start_agent(agent))  # type: ignore[misc]  # a bound default
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        """End all processes."""
        self.close()

    def _name(self, agent: int) -> str:
        return self.options.world.domain.agent_name(agent)

    def _check_certificates(self, folder: Path) -> None:
        for name in (WORLD, *[ROUTER] * bool(self.routers), *(self._name(agent) for agent in self.started_here)):
            Identity(folder, name)

    def _start_servers(self) -> None:
        world = replace(self.options.world, routers=self.routers)
        policies, runtime = sorted(set(self.policies)), self.options.runtime
        light = runtime == "onnx" and light_domain(world.domain.name) is not None
        self._servers[WORLD] = ForkServerClient(
            {
                "world": world.as_json(),
                "policies": [] if light else policies,
                "runtime": runtime,
                "remove": self._own_certs or None,
            },
            self.folder / "fork_server.log",
            self._said,
        )
        self._servers[AGENT] = self._servers[WORLD]
        if light:
            self._servers[AGENT] = ForkServerClient(
                {"light": world.domain.name, "policies": policies},
                self.folder / "fork_server_light.log",
                self._said,
            )

    def _server_of(self, name: str) -> ForkServerClient:
        role = WORLD if name == WORLD or name in self.router_names() else AGENT
        if role not in self._servers:
            raise DeploymentError("the deployment has not been started")
        return self._servers[role]

    def _add(self, name: str, start: Callable[[], None]) -> None:
        self.children[name] = Child(name, self.folder / f"{name}.log", start)
        start()

    def start_world(self) -> None:
        """Start the world's process; again, if it has died, and then it goes on from its log."""
        self.phase = "starting"
        log = self.options.world.log or str(self.folder / "run.jsonl")
        options = replace(self._world(), report=str(self.report_path), log=log)
        self._start(WORLD, WORLD, options.as_json())

    def _world(self) -> WorldOptions:
        """The world's options with the endpoints and certificates of this deployment."""
        listen = self.options.world.listen if self.routers else self.endpoint
        return replace(self.options.world, listen=listen, routers=self.routers, certs=self.certs)

    def _start_router(self, endpoint: str) -> None:
        name = f"{ROUTER}_{self.routers.index(endpoint)}"
        self._start(name, ROUTER, replace(self._world(), listen=endpoint).as_json())

    def router_names(self) -> list[str]:
        """The names of the routers' processes."""
        return [f"{ROUTER}_{number}" for number in range(len(self.routers))]

    def _way(self, agent: int) -> str:
        """Where an agent connects: the routers one after the other, each agent with another one first."""
        first = agent % max(len(self.routers), 1)
        return ",".join(self.routers[first:] + self.routers[:first]) or self.endpoint

    def start_agent(self, agent: int) -> None:
        """Start an agent's process; again, if it has died."""
        options = AgentOptions(
            agent=agent,
            policy=self.policies[agent],
            run=self.options.world.run,
            connect=self.routes.get(agent) or self._way(agent),
            certs=self.certs,
            join_timeout=self.options.world.ready_timeout,
            lease=self.options.world.lease,
            faults=dict(self.options.world.faults),
            runtime=self.options.runtime,
            log_format=self.options.world.log_format,
        )
        self._start(self._name(agent), AGENT, asdict(options))

    def _start(self, name: str, role: str, options: dict[str, Any]) -> None:
        child = self.children[name]
        child.pid, child.restart_at, child.started_at = BEING_STARTED, None, time.monotonic()
        self._server_of(name).order(start=name, role=role, options=options, log=str(child.log))

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a child that runs."""
        self._server_of(name).order(signal=name, number=number)

    def look(self, timeout: float = 0.0) -> None:
        """Take in what has happened, start again what died; wait up to `timeout` seconds for something to happen."""
        while True:
            try:
                said = self._said.get(timeout=timeout) if timeout > 0 else self._said.get_nowait()
            except queue.Empty:
                break
            timeout = 0.0
            if isinstance(said, ForkServerClient):
                raise said.failed()
            self._take_in(said)
        now = time.monotonic()
        for child in self.children.values():
            if child.restart_at is not None and now >= child.restart_at:
                child.restarts += 1
                child.start()

    def _take_in(self, said: dict[str, Any]) -> None:
        if "phase" in said:
            self.phase, self.tick, self.horizon = str(said["phase"]), int(said["tick"]), int(said["horizon"])
        elif "started" in said:
            self.children[said["started"]].pid = int(said["pid"])
        elif "ended" in said:
            self._ended(self.children[said["ended"]], int(said["code"]))

    def _ended(self, child: Child, code: int) -> None:
        child.pid, child.exit_code = 0, code
        if self.phase == "over" or (child.name == WORLD and not _world_died(code)) or code == 0:
            return
        if self.phase in ("starting", "gathering") and code == ExitCode.USER_ERROR and child.restarts == 0:
            raise DeploymentError(f"{child.name} ended with {code} before the run began: {child.complaint()}")
        now = time.monotonic()
        child.in_a_row = 0 if now - child.started_at > STEADY else child.in_a_row
        if child.in_a_row < self.options.restarts:
            child.restart_at = now + min(FIRST_DELAY * 2**child.in_a_row, LAST_DELAY)
            child.in_a_row += 1

    def wait(self, progress: Progress | None = None, stopped: Callable[[], int | None] = lambda: None) -> RunReport:
        """Wait for the end of the run; its report, with the exit codes and restarts of all processes.

        `stopped` says by which signal the run is to be ended, None to go on. Raises DeploymentError if the world
        fails for good, or an agent does before the run has begun; what is lost later is in the report. SystemExit, with
        128 + n, if the run is to be ended while no world is there that could do it.
        """
        world = self.children[WORLD]
        shown, stop = ("", -1), None
        while world.pid or world.restart_at is not None:
            if progress is not None and shown != (self.phase, self.tick):
                shown = (self.phase, self.tick)
                progress(self.phase, self.tick, self.horizon)
            if stop is None and (stop := stopped()) is not None:
                if not world.pid or self.phase == "starting":  # no world is there that could report its end
                    sys.exit(128 + stop)
                self.phase = "over"
                self.signal(WORLD, stop)
            self.look(POLL)
        self.phase = "over"
        if world.exit_code is None or not self.report_path.exists():
            raise DeploymentError(f"the world ended with {world.exit_code}: {world.complaint()}")
        if world.exit_code == ExitCode.USER_ERROR or _world_died(world.exit_code):
            self._kept = True
            raise DeploymentError(f"the world ended with {world.exit_code}: {world.complaint()}")
        self._let_leave()
        report = RunReport.from_json(read_json(self.report_path), self.report_path)
        self._kept |= report.ending.kind not in (Ending.COMPLETE, Ending.INTERRUPTED)
        return structs.replace(
            report,
            exit_codes={name: child.exit_code for name, child in self.children.items()},
            restarts={name: child.restarts for name, child in self.children.items() if child.restarts},
        )

    def _let_leave(self) -> None:
        end, routers = time.monotonic() + LEAVE, self.router_names()
        while time.monotonic() < end and any(c.pid for name, c in self.children.items() if name not in routers):
            self.look(POLL)
        for name in routers:
            self.signal(name, SIGTERM)
        while time.monotonic() < end and any(self.children[name].pid for name in routers):
            self.look(POLL)

    def close(self) -> None:
        """End all processes: their fork server asks, waits, and kills."""
        for server in set(self._servers.values()):
            server.close()
        if self._own_certs:
            shutil.rmtree(self._own_certs, ignore_errors=True)  # the fork server may have removed it already
        if not self._kept:
            shutil.rmtree(self.folder)


def _world_died(code: int) -> bool:
    """Whether a world ended otherwise than by its own decision."""
    return code < 0 or code == ExitCode.DEFECT


def deploy(
    options: DeployOptions,
    progress: Progress | None = None,
    beside: Callable[[Deployment], AbstractContextManager[object]] = nullcontext,
) -> RunReport:
    """Play one run with every agent as a process of its own; the report, with the seconds it took in all.

    `beside(deployment)` is entered when the processes have been started, and left before they are ended.
    It is also written to `options.world.report` if that is set, whatever the end, but not if the start was refused.
    Raises UnknownNameError, InvalidOptionError and InvalidFileError for what cannot be deployed, DeploymentError if the
    endpoint is in use, or naming the process that failed. SIGINT, SIGTERM and SIGHUP end all processes and then this
    one, with 128 + n.
    """
    started = time.monotonic()
    deployment: Deployment | None = None
    report: RunReport | None = None
    failed: dict[str, Any] | None = None
    try:
        with stop_signals() as stopped:
            import marl_sched.comms.transport.zenoh_session  # noqa: F401  (not installed: missed here, not in a child)

            deployment = Deployment(options)
            with deployment:
                stopped.waiting = True
                with beside(deployment):
                    report = deployment.wait(progress, lambda: stopped.number)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(ExitCode.DEFECT)
        reason = f"signal {code - 128}" if code > 128 else f"the caller ended it: {end.code}"
        failed = _no_report(options, Ending.INTERRUPTED, reason, code)
        raise
    except Exception as error:
        if deployment is not None:  # else it was refused, and nothing was started
            failed = _no_report(options, Ending.FAILED, str(error), int(ExitCode.USER_ERROR))
        raise
    finally:
        seconds = round(time.monotonic() - started, 3)
        if report is not None:
            report = structs.replace(report, seconds_in_all=seconds)
        told = failed or (None if report is None else report.as_json())
        if told is not None and options.world.report:
            write_json(options.world.report, {**told, "seconds_in_all": seconds})
    if report.ending.kind == Ending.INTERRUPTED and stopped.number is not None:
        sys.exit(128 + stopped.number)
    return report


def _no_report(options: DeployOptions, ending: Ending, reason: str, code: int) -> dict[str, Any]:
    """What there is to say of a run whose world left no report."""
    return {
        "schema": SCHEMA,
        "ending": {"kind": str(ending), "reason": reason, "exit_code": code},
        "env": options.world.domain.name,
        "run": options.world.run,
    }


def _check_policy(policy: str, domain: Domain, runtime: Runtime) -> None:
    """Raise what an agent would say of a policy that does not exist, without loading one that does."""
    if runtime == "onnx" and (light := light_domain(domain.name)) is not None:
        create_light_scheduler(policy, light)
    elif policy not in scheduler_names(domain.name) and not Path(policy).exists():
        create_scheduler(policy, domain)

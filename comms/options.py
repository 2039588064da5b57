"""What a world and a whole deployment can be told, checked before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from marl_sched.comms.agent_options import DEFAULT_ENDPOINT, require_positive
from marl_sched.comms.logs import LogFormat
from marl_sched.comms.protocol.keys import run_prefix
from marl_sched.comms.protocol.rules import ClockKind, WorldRules
from marl_sched.comms.security.identity import WORLD, Identity
from marl_sched.comms.transport.endpoints import is_encrypted, is_loopback
from marl_sched.comms.transport.faulty import Faults
from marl_sched.domain import Domain
from marl_sched.domain_parts import Telemetry
from marl_sched.errors import InvalidOptionError, require
from marl_sched.light import Runtime
from marl_sched.plugins import import_object
from marl_sched.problem import Problem

if TYPE_CHECKING:
    from marl_sched.comms.plant import Plant, SimulatedPlant
    from marl_sched.simulation import TurnSimulator

INSECURE = (
    "nothing is encrypted and nobody shows a certificate: whoever reaches {} can answer in an agent's name and hear "
    "what all agents hear"
)
Sync = Literal["never", "commit"]
Conflict = Literal["turns", "priority"]


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """The plant: which problem it plays, and how long it waits for agents. Times in seconds.

    Attributes:
        problem: of one instance, of which episode 0 is played.
        plant_factory: `package.module:function` that makes the Plant from these options; "": the domain's simulator.
        run: the run's name, part of every key.
        listen: endpoint, port 0 takes a free one.
        routers: `tls/` endpoints of routers (marl_sched.comms.router), by which agents reach a world that then does not
            listen itself; port 0 takes a free one where they are deployed.
        certs: folder of certificates, which a `tls/` endpoint needs; see `marl-sched certs`.
        insecure: whether to do without certificates on a `tcp/` endpoint, although whoever connects can then answer in
            an agent's name and hear what all agents hear. A world on the loopback interface needs no such word.
        conflict: `turns`: free agents decide in turn and see each other's choices as their view allows; `priority`: all
            free agents choose at once, and a draw settles who gets what several chose, as in the Parallel API.
        clock: who owns time: `lockstep`, `paced` or `free`; see WorldRules.
        pace: seconds per unit of simulated time, of the paced clock.
        deadline: a decision may take that long; a late one idles the agent for this decision epoch.
        patience: this many missed deadlines in a row make an incarnation of an agent count as lost. Its successors are
            given up at their first miss; after 2 x patience turns in a row that were waited for in vain nobody may
            decide for the agent for a minute. So an agent that is there and slow delays the others by at most
            2 x patience x deadline seconds before it is barred.
        grace: how long a missing agent is waited for before it counts as lost; None: 5 s, 0 with the free clock.
        quorum: share of the agents below which the lockstep clock stands still.
        standstill: time may stand still for that long before the run ends with a report.
        ready_timeout: how long to wait for all agents at the start.
        heartbeat: world and agents say at least that often that they live.
        lease: a link that is silent for that long counts as dead.
        log: file of the run's commits; a world that is started with the log of its run goes on from there. "": none.
        sync: whether every commit is forced to the disk.
        report: file for the JSON report; "" writes none.
        faults: what happens to messages of the world, see `Faults`; of its agents too where they are deployed.
        log_format: `text`, or `json`: one object a line; of its agents too where they are deployed.
    """

    problem: Problem
    plant_factory: str = ""
    run: str = "run"
    listen: str = DEFAULT_ENDPOINT
    routers: tuple[str, ...] = ()
    certs: str = ""
    insecure: bool = False
    conflict: Conflict = "turns"
    clock: ClockKind = "lockstep"
    pace: float = 1.0
    deadline: float = 2.0
    patience: int = 3
    grace: float | None = None
    quorum: float = 0.5
    standstill: float = 60.0
    ready_timeout: float = 60.0
    heartbeat: float = 0.5
    lease: float = 1.0
    log: str = ""
    sync: Sync = "never"
    report: str = ""
    faults: Mapping[str, float] = field(default_factory=dict)
    log_format: LogFormat = "text"

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        run_prefix(self.run)
        Faults.of(self.faults)
        for endpoint in self.routers:
            if not is_encrypted(endpoint):
                raise InvalidOptionError(f"routers: expected an endpoint on tls/ such as tls/a:7447, got {endpoint}")
        if not self.insecure and not is_loopback(self.listen) and not is_encrypted(self.listen):
            raise InvalidOptionError(
                f"listen: {self.listen} is reached by other machines, and {INSECURE.format('it')}. Listen on tls/ with "
                "--certs, or say --insecure (insecure: true) if nobody but yours can connect"
            )
        require("conflict", self.conflict, get_args(Conflict))
        require("clock", self.clock, get_args(ClockKind))
        require("sync", self.sync, get_args(Sync))
        require("log_format", self.log_format, get_args(LogFormat))
        require_positive(self, "pace", "deadline", "standstill", "ready_timeout", "heartbeat", "lease")
        if self.patience < 1:
            raise InvalidOptionError(f"patience: expected at least 1 missed deadline, got {self.patience}")
        if self.grace is not None and not self.grace >= 0:
            raise InvalidOptionError(f"grace: expected a number >= 0 (seconds), got {self.grace}")
        if not 0 <= self.quorum <= 1:
            raise InvalidOptionError(f"quorum: expected a share in [0, 1], got {self.quorum}")
        if self.problem.count != 1:
            raise InvalidOptionError(f"problem: expected one instance (count=1), got {self.problem.count}")

    def rules(self) -> WorldRules:
        """The protocol's numbers."""
        grace = self.grace if self.grace is not None else 0.0 if self.clock == "free" else 5.0
        return WorldRules(
            clock=self.clock,
            pace=self.pace,
            deadline=self.deadline,
            patience=self.patience,
            grace=grace,
            quorum=self.quorum,
            standstill=self.standstill,
            ready=self.ready_timeout,
            heartbeat=self.heartbeat,
            unheard=max(6 * self.heartbeat, 3 * self.lease),
        )

    def identity(self, name: str = WORLD) -> Identity | None:
        """The world's certificate, None without `certs`; InvalidOptionError for a folder that lacks it."""
        return Identity(Path(self.certs), name) if self.certs else None

    def as_json(self) -> dict[str, Any]:
        """Plain data, from which a process of the deployment makes equal options."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        return {**values, "problem": self.problem.as_json()}

    @property
    def domain(self) -> Domain:
        """The problem's domain."""
        return self.problem.domain

    def telemetry(self) -> Telemetry:
        """How the domain's state travels; InvalidOptionError if it cannot."""
        telemetry = self.domain.telemetry
        if telemetry is None:
            raise InvalidOptionError(f"env: {self.domain.name} has no telemetry and cannot be deployed")
        return telemetry

    def simulator(self, **extra: Any) -> TurnSimulator:
        """The plant's simulator, at the start of its episode; typed errors for options that do not fit.

        `extra` are further options of the domain's simulator, such as those of its pictures.
        """
        simulator = self.problem.simulator(**extra)
        simulator.reset(seed=self.problem.seed, episodes=self.problem.episode_numbers([0]))
        return simulator

    def plant(self) -> Plant:
        """What is played: the plant that `plant_factory` makes, or the simulated one."""
        if not self.plant_factory:
            return self.simulated_plant()
        made: Plant = import_object(self.plant_factory)(self)
        return made

    def simulated_plant(self, **extra: Any) -> SimulatedPlant:
        """The domain's simulator as a plant, at the start of its episode; `extra` as for `simulator`."""
        from marl_sched.comms.plant import SimulatedPlant, SimultaneousPlant

        kind = SimultaneousPlant if self.conflict == "priority" else SimulatedPlant
        return kind(self.domain, self.telemetry(), self.simulator(**extra))


@dataclass(frozen=True, kw_only=True)
class DeployOptions:
    """A world and all its agents on this machine.

    Attributes:
        world: the plant's options. It listens on a `tls/` endpoint, with certificates that are made for the run and
            removed after it unless `certs` has some; on a `tcp/` endpoint only if it is `insecure`.
        policy: what decides for every agent...
        agent_policies: ...but for these, agent's name -> policy.
        agents: names of the agents that are started here, the others elsewhere; empty: all.
        folder: where logs of all processes, the run's log and the report are kept; "": in a temporary folder, which
            is left only if the run did not end well.
        restarts: how often in a row a process that died is started again.
        runtime: by what agents decide, see AgentOptions.
    """

    world: WorldOptions
    policy: str
    agent_policies: Mapping[str, str] = field(default_factory=dict)
    agents: tuple[str, ...] = ()
    folder: str = ""
    restarts: int = 5
    runtime: Runtime = "torch"

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        if not is_encrypted(self.world.listen) and not self.world.insecure:
            raise InvalidOptionError(
                f"listen: on {self.world.listen} {INSECURE.format('it')}. Listen on tls/, or say --insecure "
                "(insecure: true) if that is what you want"
            )
        require("runtime", self.runtime, get_args(Runtime))
        if self.restarts < 0:
            raise InvalidOptionError(f"restarts: expected an integer >= 0, got {self.restarts}")

    def policies(self, n_agents: int) -> list[str]:
        """One policy per agent; UnknownNameError for an agent that does not exist."""
        names = self._names(n_agents)
        for name in self.agent_policies:
            require(f"agent of this {self.world.domain.name} problem", name, names)
        return [self.agent_policies.get(name, self.policy) for name in names]

    def started_here(self, n_agents: int) -> list[int]:
        """Indices of the agents that are started here; UnknownNameError for one that does not exist."""
        names = self._names(n_agents)
        for name in self.agents:
            require(f"agent of this {self.world.domain.name} problem", name, names)
        return [i for i, name in enumerate(names) if not self.agents or name in self.agents]

    def _names(self, n_agents: int) -> list[str]:
        return [self.world.domain.agent_name(i) for i in range(n_agents)]

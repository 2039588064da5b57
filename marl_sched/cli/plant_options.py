"""What `marl-sched world` and `deploy` are told of the problem and of the run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import OwnOptions

if TYPE_CHECKING:
    from marl_sched.comms.options import WorldOptions
    from marl_sched.problem import Problem

Certs = Annotated[
    Path | None,
    typer.Option("--certs", metavar="DIR", help="Certificates, as `marl-sched certs` makes them, for a tls/ endpoint."),
]
LogForm = Annotated[
    str, typer.Option("--log-format", help="How processes log: text, or json, an object a line and every event.")
]


def endpoint_of(encrypted: bool, port: int) -> str:
    """The endpoint on this machine where a world listens unless told otherwise."""
    return f"{'tls' if encrypted else 'tcp'}/127.0.0.1:{port}"


@dataclass(frozen=True, kw_only=True)
class Plant:
    """What `world` and `deploy` are told of the problem and of the run; each field but `own` is an option."""

    env: options.Env = options.DEFAULT_ENV
    scale: options.Scale = None
    instance: Annotated[
        Path | None,
        typer.Option(
            "--instance",
            "--instances",
            metavar="FILE",
            help="An instance file (default: the first that the seed draws).",
        ),
    ] = None
    seed: options.Seed = 0
    objective: options.Objective = None
    view: options.View = "full"
    plant_factory: Annotated[
        str,
        typer.Option("--plant", metavar="PACKAGE.MODULE:FUNCTION", help="What makes a plant (default: the simulator)."),
    ] = ""
    run: Annotated[str, typer.Option("--run", help="The run's name, by which its processes find each other.")] = "run"
    certs: Certs = None
    routers: Annotated[
        list[str] | None,
        typer.Option(
            "--router",
            metavar="ENDPOINT",
            help="A router by which agents reach the world; may be repeated.",
        ),
    ] = None
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="No certificates: whoever connects can answer in an agent's name and listen."),
    ] = False
    conflict: Annotated[
        str,
        typer.Option("--conflict", help="turns (agents decide in turn) or priority (all at once, settled by a draw)."),
    ] = "turns"
    clock: Annotated[
        str, typer.Option("--clock", help="Who owns time: lockstep (waits for missing agents), paced, or free.")
    ] = "lockstep"
    pace: Annotated[float, typer.Option("--pace", help="Seconds per unit of simulated time, of the paced clock.")] = 1.0
    deadline: Annotated[float, typer.Option("--deadline", help="Seconds that a decision may take.")] = 2.0
    patience: Annotated[
        int, typer.Option("--patience", help="Missed deadlines in a row after which an agent counts as lost.")
    ] = 3
    grace: Annotated[
        float | None,
        typer.Option("--grace", help="Seconds that a missing agent is waited for (default: 5, free clock: 0)."),
    ] = None
    quorum: Annotated[
        float, typer.Option("--quorum", help="Share of the agents below which the lockstep clock stands still.")
    ] = 0.5
    standstill: Annotated[
        float, typer.Option("--standstill", help="Seconds that time may stand still before the run ends.")
    ] = 60.0
    ready_timeout: Annotated[
        float, typer.Option("--ready-timeout", help="Seconds to wait for all agents at the start.")
    ] = 60.0
    lease: Annotated[float, typer.Option("--lease", help="Seconds of silence after which a link counts as dead.")] = 1.0
    sync: Annotated[
        str, typer.Option("--sync", help="When the log is forced to the disk: never, or at every commit.")
    ] = "never"
    log_format: LogForm = "text"
    own: OwnOptions

    def problem(self) -> Problem:
        """The problem that the words state; typed errors for words that stand for nothing."""
        return options.state_problem(
            self.env,
            self.own,
            instances=self.instance,
            scale=self.scale,
            view=self.view,
            seed=self.seed,
            objective=self.objective,
            episodes=1,
        )

    def world_options(self, listen: str, json: Path | None, log: Path | None = None) -> WorldOptions:
        """These options as the world process takes them."""
        from marl_sched.comms.options import WorldOptions

        options.check_output(json)
        return WorldOptions(
            problem=self.problem(),
            plant_factory=self.plant_factory,
            run=self.run,
            listen=listen,
            routers=tuple(self.routers or ()),
            certs=str(self.certs or ""),
            insecure=self.insecure,
            conflict=self.conflict,  # type: ignore[arg-type]  # WorldOptions refuses other words
            clock=self.clock,  # type: ignore[arg-type]  # WorldOptions refuses other words
            pace=self.pace,
            deadline=self.deadline,
            patience=self.patience,
            grace=self.grace,
            quorum=self.quorum,
            standstill=self.standstill,
            ready_timeout=self.ready_timeout,
            lease=self.lease,
            log=str(log or ""),
            sync=self.sync,  # type: ignore[arg-type]  # likewise
            report=str(json or ""),
            log_format=self.log_format,  # type: ignore[arg-type]  # likewise
        )

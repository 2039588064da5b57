"""`marl-sched world`, `agent`, `deploy`, `watch`, `certs` and `replay`: a plant and its agents as processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, OwnOptions, takes
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.comms.dashboard.watcher import Watcher
    from marl_sched.comms.launcher import Deployment
    from marl_sched.comms.metrics.report import AgentReport, RunReport
    from marl_sched.comms.options import WorldOptions
    from marl_sched.problem import Problem

_PROBLEM = f"--env {options.DEFAULT_ENV} --scale small --seed 1 --view local --reach 1 --comm 1"

Policy = Annotated[str, typer.Option("--policy", help="A rule's or shipped policy's name, or a checkpoint's path.")]
Progress = Callable[[str, int, int], None]  # (phase, simulated time, horizon)
Json = options.JsonFile
Certs = Annotated[
    Path | None,
    typer.Option("--certs", metavar="DIR", help="Certificates, as `marl-sched certs` makes them, for a tls/ endpoint."),
]
Web = Annotated[
    int | None,
    typer.Option(
        "--web", metavar="PORT", min=0, max=65535, help="Show the run on a page of this machine; 0: a free port."
    ),
]
Log = Annotated[
    Path | None,
    typer.Option("--log", metavar="FILE", help="The run's log of decisions; a world started with it goes on from it."),
]


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    example = f"Example: marl-sched world {_PROBLEM} --certs certs --listen tls/0.0.0.0:7447 --json run.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Plant)(world))
    app.command(epilog="Example: marl-sched agent --agent 3 --policy condition --certs certs --connect tls/plant:7447")(
        agent
    )
    app.command(epilog="Example: marl-sched certs --out certs --agents crew_0..crew_6 --host plant")(certs)
    example = f"Example: marl-sched deploy {_PROBLEM} --policy random --agent-policy crew_3=condition --json run.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Plant)(deploy))
    app.command(epilog="Example: marl-sched watch --connect tls/127.0.0.1:7447 --certs certs --web 8080")(watch)
    app.command(epilog="Example: marl-sched replay out/run/run.jsonl --picture run.png")(replay)


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
        )


def world(
    plant: Plant,
    *,
    listen: Annotated[
        str, typer.Option("--listen", metavar="ENDPOINT", help="Where to listen (default: 127.0.0.1:7447).")
    ] = "",
    log: Log = None,
    json: Json = None,
) -> None:
    """Be the plant of a run: own the simulator, tell what happens, apply the agents' decisions."""
    from marl_sched.comms.world import serve

    chosen = plant.world_options(listen or _endpoint(plant.certs is not None, 7447), json, log)
    with progress_bar() as tell:
        report = serve(chosen, _warning_of_insecurity(chosen, tell))
    finish(report)


def agent(
    agent: Annotated[int, typer.Option("--agent", metavar="I", help="Index of the agent to be.")],
    policy: Policy,
    run: Annotated[str, typer.Option("--run", help="The world's run.")] = "run",
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="Where the world listens (default: 127.0.0.1:7447).")
    ] = "",
    certs: Certs = None,
    join_timeout: Annotated[float, typer.Option("--join-timeout", help="Seconds to wait for the world.")] = 60.0,
    lease: Annotated[
        float, typer.Option("--lease", help="Seconds of silence after which a link counts as dead.")
    ] = 1.0,
) -> None:
    """Be one agent of a run: see through its view and decide with its policy."""
    from marl_sched.comms.agent import run as be_agent
    from marl_sched.comms.options import AgentOptions

    be_agent(
        AgentOptions(
            agent=agent,
            policy=policy,
            run=run,
            connect=connect or _endpoint(certs is not None, 7447),
            certs=str(certs or ""),
            join_timeout=join_timeout,
            lease=lease,
        )
    )


def deploy(
    plant: Plant,
    *,
    policy: Policy,
    agent_policy: Annotated[
        list[str] | None,
        typer.Option("--agent-policy", metavar="AGENT=POLICY", help="Another policy for one agent; may be repeated."),
    ] = None,
    listen: Annotated[
        str,
        typer.Option(
            "--listen", metavar="ENDPOINT", help="Where the world listens (default: a free port of loopback, with TLS)."
        ),
    ] = "",
    agents: Annotated[
        str, typer.Option("--agents", metavar="A,B", help="Agents to start here, the others elsewhere (default: all).")
    ] = "",
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder", metavar="DIR", help="Where to keep every process's log, the run's log and the report."
        ),
    ] = None,
    restarts: Annotated[
        int, typer.Option("--restarts", help="How often in a row a process that died is started again.")
    ] = 5,
    live: Annotated[bool, typer.Option("--live", help="Show the agents in the terminal while they run.")] = False,
    web: Web = None,
    json: Json = None,
) -> None:
    """Start the plant and one process for each agent, watch over them, and report what they did."""
    from marl_sched.agents.registry import card_of
    from marl_sched.comms.launcher import deploy as launch
    from marl_sched.comms.options import DeployOptions

    by_agent = _by_agent(agent_policy or [])
    problem = plant.problem()
    chosen = DeployOptions(
        world=plant.world_options(listen or _endpoint(not plant.insecure, 0), json),
        policy=policy,
        agent_policies=by_agent,
        agents=tuple(name for name in agents.split(",") if name),
        folder=str(folder or ""),
        restarts=restarts,
    )
    for name in dict.fromkeys([policy, *by_agent.values()]):
        options.tell_of_training(name, card_of(name, problem.domain), problem.view, problem.objective)
    with progress_bar(hidden=live) as tell:
        report = launch(
            chosen, _warning_of_insecurity(chosen.world, tell), lambda deployment: _shown(deployment, live, web)
        )
    finish(report)


def watch(
    run: Annotated[str, typer.Option("--run", help="The world's run.")] = "run",
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="Where the world listens (default: 127.0.0.1:7447).")
    ] = "",
    certs: Certs = None,
    web: Web = None,
) -> None:
    """Look at a running deployment, in this terminal or in a browser, without touching it."""
    from marl_sched.comms.dashboard.terminal import follow

    with (
        _watching(run, connect or _endpoint(certs is not None, 7447), str(certs or "")) as watcher,
        _page(watcher, web),
    ):
        try:
            follow(watcher)
        except KeyboardInterrupt:
            typer.echo("no longer looking; the run goes on", err=True)


@contextmanager
def _shown(deployment: Deployment, live: bool, web: int | None) -> Iterator[None]:
    """Show a deployment while it runs, in the terminal or on a page or not at all."""
    if not live and web is None:
        yield
        return
    from marl_sched.comms.dashboard.terminal import following

    with ExitStack() as stack:
        given = deployment.options.world
        watcher = stack.enter_context(_watching(given.run, deployment.endpoint, deployment.certs))
        stack.enter_context(_page(watcher, web))
        if live:
            stack.enter_context(following(watcher))
        yield


def _watching(run: str, endpoint: str, certs: str) -> Watcher:
    from marl_sched.comms.dashboard.watcher import Watcher
    from marl_sched.comms.security.identity import OBSERVER, Identity
    from marl_sched.comms.transport.zenoh_session import spoke

    identity = Identity(Path(certs), OBSERVER) if certs else None
    return Watcher(lambda: spoke(run, endpoint, 1.0, identity=identity))


@contextmanager
def _page(watcher: Watcher, port: int | None) -> Iterator[None]:
    if port is None:
        yield
        return
    from marl_sched.comms.dashboard.web import serving

    with serving(watcher, port) as server:
        typer.echo(f"the run is shown at {server.address}", err=True)
        yield


def replay(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="A run's log, as `world --log` and `deploy --folder` keep it.")
    ],
    picture: Annotated[Path | None, typer.Option("--picture", metavar="FILE", help="Draw the run as PNG.")] = None,
    json: Json = None,
) -> None:
    """Play a deployed run again from its log, to the last bit, and report it."""
    from marl_sched.comms.replay import replay as play_log
    from marl_sched.files import write_json

    options.check_output(json)
    options.check_output(picture)
    if not log.is_file():
        raise InvalidOptionError(f"{log}: expected a run's log, there is no such file")
    report = play_log(log, picture)
    if json is not None:
        write_json(json, report.as_json())
    print_report(report)


def certs(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write them.")],
    agents: Annotated[str, typer.Option("--agents", metavar="A,B,C..D", help="Agents' names, such as crew_0..crew_6.")],
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="An address or name by which agents reach the world; may be repeated."),
    ] = None,
    days: Annotated[int, typer.Option("--days", help="For which they are valid.")] = 365,
) -> None:
    """Make an authority and certificates for a world, observers and agents; with DIR's authority if it has one."""
    from marl_sched.comms.security.certificates import agent_names, make_certificates

    made = make_certificates(out, agent_names(agents), hosts=host or [], days=days)
    typer.echo(f"{out}: {', '.join(made) or 'nothing new'}")
    typer.echo("Take ca.pem and its own .pem and .key to each host; ca.key stays where it is, and nowhere else.")


def _endpoint(encrypted: bool, port: int) -> str:
    return f"{'tls' if encrypted else 'tcp'}/127.0.0.1:{port}"


def _warning_of_insecurity(world: WorldOptions, tell: Progress) -> Progress:
    """The same, which first says what is given up without certificates, when the world is there."""
    from marl_sched.comms.options import INSECURE
    from marl_sched.comms.transport.endpoints import is_encrypted

    pending = [] if is_encrypted(world.listen) else [f"insecure: {INSECURE.format(world.listen)}"]

    def tell_once(phase: str, tick: int, horizon: int) -> None:
        while pending and phase != "starting":
            typer.echo(pending.pop(), err=True)
        tell(phase, tick, horizon)

    return tell_once


@contextmanager
def progress_bar(hidden: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """A bar on stderr, where there is a terminal, that follows (phase, simulated time, horizon)."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=hidden or not console.is_terminal) as progress:
        task = progress.add_task("starting", total=None)

        def tell(phase: str, tick: int, horizon: int) -> None:
            progress.update(task, description=phase, completed=tick, total=horizon or None)

        yield tell


def finish(report: RunReport) -> None:
    """Print the end of a run, and exit as it ended."""
    print_report(report)
    if report.ending.exit_code:
        raise typer.Exit(report.ending.exit_code)


def print_report(report: RunReport) -> None:
    """The end of a run in a few lines."""
    latency, messages = report.latency_ms, report.messages
    if report.ending.kind != "complete":
        typer.echo(f"the run did not come to its end: {report.ending.reason}")
    typer.echo(f"{report.progress} {report.unit}, {len(report.agents)} agents, {len(report.decisions)} decisions")
    typer.echo(f"M1 ({report.objective}): {report.M1:.4f}")
    _print_shares(report.agents)
    if report.from_log is not None:
        return
    typer.echo(f"{messages.count} messages, {messages.bytes} bytes")
    if latency.p50 is not None and latency.p99 is not None:
        typer.echo(f"decision latency: p50 {latency.p50:.2f} ms, p99 {latency.p99:.2f} ms")
    for death in report.deaths:
        typer.echo(f"lost: {report.time_unit} {death.time}, {death.agent}, {death.event}, waited {death.waited_s} s")


def _print_shares(agents: list[AgentReport]) -> None:
    """How evenly the agents worked, where the environment counts that."""
    shares = {one.name: one.figures["utilisation"] for one in agents if "utilisation" in one.figures}
    if not shares:
        return
    least, most = min(shares, key=shares.__getitem__), max(shares, key=shares.__getitem__)
    typer.echo(
        f"utilisation of agents: {sum(shares.values()) / len(shares):.3f}, "
        f"from {least} {shares[least]:.3f} to {most} {shares[most]:.3f}"
    )


def _by_agent(pairs: list[str]) -> dict[str, str]:
    policies = {}
    for pair in pairs:
        agent, found, policy = pair.partition("=")
        if not found or not agent or not policy:
            raise InvalidOptionError(f"--agent-policy: expected AGENT=POLICY such as crew_3=condition, got {pair!r}")
        policies[agent] = policy
    return policies

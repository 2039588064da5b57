"""`marl-sched world`, `agent`, `deploy`, `certs` and `replay`: a plant and its agents as processes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, takes
from marl_sched.cli.plant_options import Certs, LogForm, Plant, endpoint_of
from marl_sched.cli.run_printing import finish, print_report, progress_bar
from marl_sched.cli.watching import Web, shown, watch
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.comms.options import WorldOptions

_PROBLEM = f"--env {options.DEFAULT_ENV} --scale small --seed 1 --view local --reach 1 --comm 1"

Policy = Annotated[str, typer.Option("--policy", help="A rule's or shipped policy's name, or a checkpoint's path.")]
Progress = Callable[[str, int, int], None]  # (phase, simulated time, horizon)
Json = options.JsonFile
Log = Annotated[
    Path | None,
    typer.Option("--log", metavar="FILE", help="The run's log of decisions; a world started with it goes on from it."),
]


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    example = f"Example: marl-sched world {_PROBLEM} --certs certs --listen tls/0.0.0.0:7447 --json run.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Plant)(world))
    example = f"Example: marl-sched router {_PROBLEM} --certs certs --router tls/a:7447 --router tls/b:7447 "
    app.command(epilog=f"{example}--listen tls/a:7447", context_settings=DOMAIN_OPTIONS)(takes(Plant)(router))
    app.command(epilog="Example: marl-sched agent --agent 3 --policy condition --certs certs --connect tls/plant:7447")(
        agent
    )
    app.command(epilog="Example: marl-sched certs --out certs --agents crew_0..crew_6 --host plant")(certs)
    example = f"Example: marl-sched deploy {_PROBLEM} --policy random --agent-policy crew_3=condition --json run.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Plant)(deploy))
    app.command(epilog="Example: marl-sched watch --connect tls/127.0.0.1:7447 --certs certs --web 8080")(watch)
    app.command(epilog="Example: marl-sched replay out/run/run.jsonl --picture run.png")(replay)


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

    chosen = plant.world_options(listen or endpoint_of(plant.certs is not None, 7447), json, log)
    with progress_bar() as tell:
        report = serve(chosen, _warning_of_insecurity(chosen, tell))
    finish(report)


def router(
    plant: Plant,
    *,
    listen: Annotated[str, typer.Option("--listen", metavar="ENDPOINT", help="Where to listen, one of the --router.")],
) -> None:
    """Be a router of a run: with two of them the loss of one ends no run. Takes the problem that the world plays."""
    from marl_sched.comms.router import route

    route(plant.world_options(listen, None))


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
    runtime: Annotated[
        str, typer.Option("--runtime", help="What agents decide by: torch, or onnx, without PyTorch and Numba.")
    ] = "torch",
    log_format: LogForm = "text",
) -> None:
    """Be one agent of a run: see through its view and decide with its policy."""
    from marl_sched.comms.agent import run as be_agent
    from marl_sched.comms.agent_options import AgentOptions

    be_agent(
        AgentOptions(
            agent=agent,
            policy=policy,
            run=run,
            connect=connect or endpoint_of(certs is not None, 7447),
            certs=str(certs or ""),
            join_timeout=join_timeout,
            lease=lease,
            runtime=runtime,  # type: ignore[arg-type]  # AgentOptions refuses other words
            log_format=log_format,  # type: ignore[arg-type]  # likewise
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
    runtime: Annotated[
        str, typer.Option("--runtime", help="What agents decide by: torch, or onnx, without PyTorch and Numba.")
    ] = "torch",
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
        world=plant.world_options(listen or endpoint_of(not plant.insecure, 0), json),
        policy=policy,
        agent_policies=by_agent,
        agents=tuple(name for name in agents.split(",") if name),
        folder=str(folder or ""),
        restarts=restarts,
        runtime=runtime,  # type: ignore[arg-type]  # DeployOptions refuses other words
    )
    for name in dict.fromkeys([policy, *by_agent.values()]):
        options.tell_of_training(name, card_of(name, problem.domain), problem.view, problem.objective)
    with progress_bar(hidden=live) as tell:
        report = launch(
            chosen, _warning_of_insecurity(chosen.world, tell), lambda deployment: shown(deployment, live, web)
        )
    finish(report)


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


def _by_agent(pairs: list[str]) -> dict[str, str]:
    policies = {}
    for pair in pairs:
        agent, found, policy = pair.partition("=")
        if not found or not agent or not policy:
            raise InvalidOptionError(f"--agent-policy: expected AGENT=POLICY such as crew_3=condition, got {pair!r}")
        policies[agent] = policy
    return policies

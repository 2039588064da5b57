"""`marl-sched demo`: seven crews as seven processes keep a fleet flying for thirty days, held against central rules."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.cli.selection import Resolved, create_schedulers
from marl_sched.errors import DeploymentError

if TYPE_CHECKING:
    from marl_sched.domain import Domain
    from marl_sched.simulation import TurnSimulator

ENV, SCALE, OBJECTIVE, HOURS = "airme", "small", "profit", 720
SEED = 0  # the first small instance that it draws has seven crews
RULES = ("corrective", "condition", "model-based", "preventive-first")
COMPARISON_SEED, INSTANCES, EPISODES = 90_001, 10, 2


def add_to(app: typer.Typer) -> None:
    """Register this file's command."""
    app.command(epilog="Example: marl-sched demo --out out/demo")(demo)


def demo(
    policy: Annotated[
        str, typer.Option("--policy", help="What decides in every crew: a shipped policy, a rule or a checkpoint.")
    ] = "airme-local-profit",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for results and plots.")] = Path("out/demo"),
) -> None:
    """Deploy a policy with a local view, a process per crew, and compare it with schedulers that see everything."""
    from marl_sched.cli.deployment import print_report
    from marl_sched.cli.tables import print_scores
    from marl_sched.domain import get_domain
    from marl_sched.files import write_json
    from marl_sched.train.evaluation.compare import draw_scores, draw_timelines

    options.check_folder(out)
    domain = get_domain(ENV)
    view = _view_of(domain, policy)

    typer.echo(f"1. Thirty days with a process for every crew, each sees its surroundings: {_words(view)}")
    report = _deploy(policy, view, out / "deployment.json")
    print_report(report)
    episodes = _same_month(domain, policy, view)
    replay, *_ = episodes.values()
    _require_equal(report[OBJECTIVE], domain, replay)
    typer.echo("The same month played in one process is the same to the last bit.")

    typer.echo(
        f"\n2. {INSTANCES} other fleets x {EPISODES} months: crews that see their surroundings, and central schedulers"
    )
    local = _compare(domain, [policy, "condition", "preventive-first"], view)
    full = _compare(domain, [*RULES, *_central_policies()], domain.views["full"]())
    print_scores(local)
    print_scores(full)

    for name, table in (("local", local), ("full", full)):
        write_json(out / f"results-{name}-view.json", table)
    draw_scores(out / "scores.png", local, full)
    draw_timelines(out / "timelines.png", domain, episodes, OBJECTIVE)
    for path in sorted(out.iterdir()):
        typer.echo(path)


def _view_of(domain: Domain, policy: str) -> Any:
    """The view that a policy was trained with; a rule gets the local view as it comes."""
    card = getattr(create_schedulers(domain, policy)[policy], "card", None)
    if card is None:
        return domain.views["local"]()
    words = dict(card.view)
    return options.build_view(domain, words.pop("kind"), words)


def _deploy(policy: str, view: Any, path: Path) -> dict[str, Any]:
    from marl_sched.cli.deployment import progress_bar
    from marl_sched.comms.launcher import deploy
    from marl_sched.comms.options import DeployOptions, WorldOptions

    world = WorldOptions(
        env=ENV,
        scale=SCALE,
        seed=SEED,
        hours=HOURS,
        objective=OBJECTIVE,
        view=view.kind,
        view_options=asdict(view),
        listen="tcp/127.0.0.1:0",
        report=str(path),
    )
    with progress_bar() as tell:
        return deploy(DeployOptions(world=world, policy=policy), tell)


def _require_equal(deployed: list[float], domain: Domain, replay: TurnSimulator) -> None:
    """DeploymentError, which names the first hour that differs, unless a month is the one played in one process."""
    if domain.telemetry is None:
        raise DeploymentError(f"demo: the environment {domain.name} has no telemetry to deploy it by")
    together = domain.telemetry.series(replay)[OBJECTIVE]
    if deployed == together:
        return
    pairs = enumerate(zip(deployed, together, strict=False))
    hour = next((hour for hour, (one, other) in pairs if one != other), min(len(deployed), len(together)))
    raise DeploymentError(f"demo: the deployed month is not the one played in one process: {OBJECTIVE} of hour {hour}")


def _same_month(domain: Domain, policy: str, view: Any) -> dict[str, TurnSimulator]:
    """The deployed episode in one process: by the policy, then by rules that see and decide everything."""
    from marl_sched.train.evaluation.compare import play_episode
    from marl_sched.train.evaluation.evaluate import Settings

    instance = domain.instances(SCALE, 1, SEED)[0]
    together = Settings(objective=OBJECTIVE, horizon=HOURS, scale=SCALE, seed=SEED)
    alone = replace(together, view=view)
    months = {f"{policy}, one process per crew": (policy, alone)}
    months |= {f"{rule}, centralised": (rule, together) for rule in ("corrective", "preventive-first")}
    return {
        caption: play_episode(domain, create_schedulers(domain, name)[name], instance, chosen)
        for caption, (name, chosen) in months.items()
    }


def _compare(domain: Domain, names: list[str], view: Any) -> dict[str, Any]:
    from marl_sched.cli.evaluation import play
    from marl_sched.train.evaluation.evaluate import Settings

    instances = domain.instances(SCALE, INSTANCES, COMPARISON_SEED)
    settings = Settings(episodes=EPISODES, seed=COMPARISON_SEED, view=view, objective=OBJECTIVE, scale=SCALE)
    return play(Resolved(domain, create_schedulers(domain, ",".join(names)), instances, settings), None)


def _central_policies() -> list[str]:
    """Shipped policies that were trained for the demo's objective with the full view."""
    from marl_sched.agents.registry import shipped_policies

    return [
        name
        for name, card in shipped_policies().items()
        if (card.domain, card.objective, card.view["kind"]) == (ENV, OBJECTIVE, "full")
    ]


def _words(view: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in asdict(view).items()) or "everything"

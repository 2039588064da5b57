"""`marl-sched demo`: one process per agent plays an episode, and is held against schedulers that see everything."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.selection import Resolved, create_schedulers
from marl_sched.errors import DeploymentError, InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.comms.metrics.report import RunReport
    from marl_sched.domain import Domain
    from marl_sched.domain_parts import Demo
    from marl_sched.problem import Problem
    from marl_sched.simulation import TurnSimulator
    from marl_sched.train.evaluation.results import Results


def add_to(app: typer.Typer) -> None:
    """Register this file's command."""
    app.command(epilog="Example: marl-sched demo --out out/demo")(demo)


def demo(
    env: options.Env = options.DEFAULT_ENV,
    policy: Annotated[
        str | None, typer.Option("--policy", help="What decides in every agent (default: the environment's choice).")
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for results and plots.")] = Path("out/demo"),
) -> None:
    """Deploy a policy with a local view, a process per agent, and compare it with schedulers that see everything."""
    from marl_sched.cli.run_printing import print_report
    from marl_sched.cli.tables import print_scores
    from marl_sched.domain import get_domain
    from marl_sched.files import write_json
    from marl_sched.problem import view_in_words
    from marl_sched.train.evaluation.animation import save_animation
    from marl_sched.train.evaluation.compare import draw_scores, draw_timelines

    options.check_folder(out)
    domain = get_domain(env)
    shown = _require_demo(domain)
    policy = policy or shown.policy
    problem = deployed_problem(domain, policy)

    seen = view_in_words(problem.view)
    typer.echo(f"1. {problem.length} with a process for every {domain.agent_prefix}, each with the view {seen}")
    report = _deploy(policy, problem, out / "deployment.json")
    print_report(report)
    episodes = _same_episode(problem, policy, shown)
    replay, *_ = episodes.values()
    require_equal(report.series[problem.objective], problem, replay)
    typer.echo("The same episode played in one process is the same to the last bit.")

    typer.echo(f"\n2. {shown.instances} other instances x {shown.episodes} episodes: this view, and central schedulers")
    other = problem.but(count=shown.instances, episodes=shown.episodes, seed=shown.comparison_seed)
    local = _compare(other, [policy, *shown.local_rules])
    full = _compare(other.but(view=None), [*shown.central_rules, *_central_policies(other)])
    print_scores(local)
    print_scores(full)

    for name, table in (("local", local), ("full", full)):
        write_json(out / f"results-{name}-view.json", table.as_json())
    draw_scores(out / "scores.png", local, full)
    draw_timelines(out / "timelines.png", domain, episodes, problem.objective)
    if domain.frames is not None:
        save_animation(out / "episode.gif", domain.frames(replay))
    for path in sorted(out.iterdir()):
        typer.echo(path)


def _require_demo(domain: Domain) -> Demo:
    if domain.demo is None:
        raise InvalidOptionError(f"--env: the environment {domain.name!r} has no demonstration")
    return domain.demo


def deployed_problem(domain: Domain, policy: str) -> Problem:
    """The episode that is deployed, under the view that its policy was trained with; a rule gets a local one."""
    from marl_sched.problem import Problem

    shown = _require_demo(domain)
    card = getattr(create_schedulers(domain, [policy])[policy], "card", None)
    local = next(kind for kind in domain.views if kind != "full")
    return Problem(
        domain,
        scale=shown.scale,
        count=1,
        seed=shown.seed,
        episodes=1,
        objective=shown.objective,
        view=local if card is None else card.view,
        options=dict(shown.options),
    )


def _deploy(policy: str, problem: Problem, path: Path) -> RunReport:
    from marl_sched.cli.run_printing import progress_bar
    from marl_sched.comms.launcher import deploy
    from marl_sched.comms.options import DeployOptions, WorldOptions

    world = WorldOptions(
        problem=problem,
        listen="tls/127.0.0.1:0",
        report=str(path),
    )
    with progress_bar() as tell:
        return deploy(DeployOptions(world=world, policy=policy), tell)


def require_equal(deployed: list[float], problem: Problem, replay: TurnSimulator) -> None:
    """DeploymentError, which names the first time that differs, unless an episode is the one played in one process."""
    if problem.domain.telemetry is None:
        raise DeploymentError(f"demo: the environment {problem.domain.name} has no telemetry to deploy it by")
    together = problem.domain.telemetry.series(replay)[problem.objective]
    if deployed == together:
        return
    pairs = enumerate(zip(deployed, together, strict=False))
    time = next((time for time, (one, other) in pairs if one != other), min(len(deployed), len(together)))
    raise DeploymentError(
        f"demo: the deployed episode is not the one played in one process: {problem.objective} at time {time} "
        f"({replay.time_unit})"
    )


def _same_episode(problem: Problem, policy: str, shown: Demo) -> dict[str, TurnSimulator]:
    """The deployed episode in one process: by the policy, then by rules that see and decide everything."""
    from marl_sched.train.evaluation.compare import play_episode

    prefix, together = problem.domain.agent_prefix, problem.but(view=None)
    episodes = {f"{policy}, one process per {prefix}": (policy, problem)}
    episodes |= {f"{rule}, centralised": (rule, together) for rule in (shown.central_rules[0], shown.central_rules[-1])}
    return {
        caption: play_episode(chosen, create_schedulers(problem.domain, [name])[name])
        for caption, (name, chosen) in episodes.items()
    }


def _compare(problem: Problem, names: list[str]) -> Results:
    from marl_sched.cli.evaluation import play

    return play(Resolved(problem, create_schedulers(problem.domain, names)), None)


def _central_policies(problem: Problem) -> list[str]:
    """Shipped policies that were trained for the problem's objective with the full view."""
    from marl_sched.agents.registry import shipped_policies

    wanted = (problem.domain.name, problem.objective, "full")
    return [
        name for name, card in shipped_policies().items() if (card.domain, card.objective, card.view["kind"]) == wanted
    ]

"""`marl-sched evaluate`, `compare` and `bench`: schedulers held against each other, and how fast everything is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from marl_sched.cli import options
from marl_sched.cli.compilation import told_of_compilation
from marl_sched.cli.grouped import DOMAIN_OPTIONS, takes
from marl_sched.cli.selection import Resolved, Selection
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.problem import Problem
    from marl_sched.train.evaluation.results import Results

_SELECTORS = (
    f"--env {options.DEFAULT_ENV} --scale small --instances 100 --episodes 10 --schedulers corrective,condition"
)


BECAME_SLOWER = 1  # exit code of `bench --against`
SaveSchedules = Annotated[
    Path | None, typer.Option("--save-schedules", metavar="DIR", help="Write every round's schedule here, as JSON.")
]

Agents = Annotated[bool, typer.Option("--agents", help="Print also what single agents did.")]


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    example = f"Example: marl-sched evaluate {_SELECTORS} --view local --reach 1 --json results.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Selection)(evaluate))
    example = f"Example: marl-sched compare {_SELECTORS} --out out/compare"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Selection)(compare))
    app.command(epilog=f"Example: marl-sched bench --env {options.DEFAULT_ENV} --json bench.json")(bench)


def evaluate(
    selection: Selection,
    *,
    json: options.JsonFile = None,
    format: options.Format = "table",
    agents: Agents = False,
    save_schedules: SaveSchedules = None,
) -> None:
    """Play schedulers on the same instances with the same noise and print their scores."""
    from marl_sched.cli.agents_table import print_agents
    from marl_sched.cli.tables import FORMATS, print_scores
    from marl_sched.errors import require
    from marl_sched.files import STDOUT, write_json

    options.check_output(json)
    require("format", format, FORMATS)
    if save_schedules is not None:
        options.check_folder(save_schedules, "--save-schedules")
    results = play(selection.resolve(), selection.baseline, save_schedules)
    print_scores(results, format, stderr=json == STDOUT)  # first: what was computed is seen, whatever the disk says
    if agents:
        print_agents(results, format, stderr=json == STDOUT)
    if json is not None:
        write_json(json, results.as_json())


def compare(
    selection: Selection,
    *,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results and the plots.")],
    json: options.JsonFile = None,
    format: options.Format = "table",
    agents: Agents = False,
    save_schedules: SaveSchedules = None,
    log: Annotated[
        list[Path] | None, typer.Option("--log", metavar="CSV", help="A training log to plot; may be repeated.")
    ] = None,
) -> None:
    """As evaluate, and draw the scores, an episode of every scheduler and the learning curves of training logs."""
    from marl_sched.cli.agents_table import print_agents
    from marl_sched.cli.tables import FORMATS, print_scores
    from marl_sched.domain import get_domain
    from marl_sched.errors import InvalidOptionError, require
    from marl_sched.files import STDOUT, write_json
    from marl_sched.train.evaluation.compare import draw_learning_curves, draw_scores, draw_timelines, play_episode

    options.check_folder(out)
    options.check_output(json)
    if json is not None and json.absolute() == out.absolute():
        raise InvalidOptionError(f"--json: {json} is the folder of --out, expected a file")
    require("format", format, FORMATS)
    if save_schedules is not None:
        options.check_folder(save_schedules, "--save-schedules")
    if log:  # first, as a log may be malformed
        better = get_domain(selection.env).better
        typer.echo(draw_learning_curves(out / "learning.png", log, better=better))
    resolved = selection.resolve()
    results = play(resolved, selection.baseline, save_schedules)
    print_scores(results, format, stderr=json == STDOUT)
    if agents:
        print_agents(results, format, stderr=json == STDOUT)
    for path in (out / "results.json", json):
        if path is not None:
            write_json(path, results.as_json())
    typer.echo(out / "results.json")
    typer.echo(draw_scores(out / "scores.png", results))
    problem = resolved.problem
    episodes = {name: play_episode(problem, scheduler) for name, scheduler in resolved.schedulers.items()}
    typer.echo(draw_timelines(out / "timelines.png", problem.domain, episodes, problem.objective))


def play(resolved: Resolved, baseline: str | None, schedules: Path | None = None) -> Results:
    """Evaluate what was selected, and tell on stderr how far it is.

    `schedules` is a folder for the schedules of every round, with a folder for each scheduler; None: none are kept.
    """
    from marl_sched.agents.registry import create_scheduler
    from marl_sched.cli.progress import progress
    from marl_sched.train.evaluation.evaluate import evaluate
    from marl_sched.train.malloc import keep_freed_memory

    keep_freed_memory()
    domain = resolved.problem.domain
    with told_of_compilation(), progress() as tell:
        table = evaluate(
            resolved.problem,
            resolved.schedulers,
            reference=create_scheduler(domain.reference, domain) if domain.reference else None,
            baseline=baseline,
            progress=tell,
            ended=None if schedules is None else _keeper(resolved.problem, schedules),
        )
        return table.results()


def _keeper(problem: Problem, folder: Path) -> Callable[[str, Any, range], None]:
    """Writes the schedules of simulators whose episodes are over; InvalidOptionError where a domain has none."""
    save = problem.domain.save_schedules
    if save is None:
        raise InvalidOptionError(f"--save-schedules: the environment {problem.domain.name!r} has no schedules")
    files = problem.files or (None,) * problem.count

    def keep(name: str, simulator: Any, rows: range) -> None:
        place = folder / name.replace("/", "-")
        place.mkdir(parents=True, exist_ok=True)
        for row, number in enumerate(rows):
            instance, episode = divmod(number, problem.episodes)
            file = files[instance]
            stem = f"instance{instance}" if file is None else file.stem
            save(simulator, row, place / f"{stem}-episode{episode}")

    return keep


def bench(
    env: options.Env = options.DEFAULT_ENV,
    json: options.JsonFile = None,
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="Measurements; the best is reported.")] = 5,
    batch: Annotated[
        int | None, typer.Option("--batch", min=1, help="Envs of what is measured in batches (default 1024).")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option("--against", metavar="FILE", help="Earlier figures; ends with 1 if one is 10 percent slower."),
    ] = None,
    deployed: Annotated[
        str | None,
        typer.Option("--deployed", metavar="RULE", help="Measure instead what turns of processes of this rule cost."),
    ] = None,
    scale: options.Scale = None,
) -> None:
    """Measure how fast the simulator, its environment APIs and the policy are on this machine, on one thread.

    `--against` holds the figures against those that `--json` wrote before, each in units of a calibration that is
    measured beside them, so that the machines need not be the same. `--deployed` plays a run of `--scale` as processes
    under the local view, beside a bare exchange over Zenoh of the same telemetry by as many processes.
    """
    if deployed is not None:
        _bench_deployment(env, scale, deployed, json)
        return
    from marl_sched.cli.tables import print_bench
    from marl_sched.domain import get_domain
    from marl_sched.files import STDOUT, write_json
    from marl_sched.train.bench import SLOWER, read_bench
    from marl_sched.train.bench import bench as measure

    options.check_output(json)
    earlier = None if against is None else read_bench(against)
    with told_of_compilation():
        now = measure(get_domain(env), repeats=repeats, batch=batch)
    print_bench(now, earlier, stderr=json == STDOUT)
    if json is not None:
        write_json(json, msgspec.to_builtins(now))
    if earlier is not None and any(ratio > SLOWER for ratio in now.against(earlier).values()):
        raise typer.Exit(BECAME_SLOWER)


def _bench_deployment(env: str, scale: str | None, rule: str, json: Path | None) -> None:
    from marl_sched.comms.bench import measure
    from marl_sched.comms.options import WorldOptions
    from marl_sched.domain import get_domain
    from marl_sched.files import write_json
    from marl_sched.problem import Problem

    view = next((kind for kind, view in get_domain(env).views.items() if view().hides), None)
    problem = Problem(env, scale=scale, count=1, view=view)
    with told_of_compilation():
        figures = measure(WorldOptions(problem=problem, listen="tcp/127.0.0.1:0", insecure=True, deadline=30.0), rule)
    for name, value in msgspec.to_builtins(figures).items():
        typer.echo(f"{name:>14}  {value}")
    if json is not None:
        write_json(json, msgspec.to_builtins(figures))

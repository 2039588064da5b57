"""`marl-sched schedule` and `validate`: the schedules of one instance, explained, drawn and checked."""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, OwnOptions, takes_own
from marl_sched.errors import InvalidFileError, InvalidOptionError, MarlSchedError

if TYPE_CHECKING:
    from marl_sched.agents.base import Scheduler
    from marl_sched.domain import Domain
    from marl_sched.planning import Schedules
    from marl_sched.problem import Problem

REFUTED = 1  # exit code of `validate` for a schedule that is infeasible or not what it says


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    example = "Example: marl-sched schedule plant.json --scheduler lst,exact --bound --out out/plant"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes_own(schedule))
    app.command(epilog="Example: marl-sched validate out/plant/lst.json")(validate)


def schedule(
    own: OwnOptions,
    instance: Annotated[Path, typer.Argument(metavar="INSTANCE", help="In any format that has a loader, or a CSV.")],
    scheduler: Annotated[
        list[str], typer.Option("--scheduler", metavar="A,B", help="Rules, solvers and policies; may be repeated.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for what is written.")] = Path(
        "out/schedule"
    ),
    env: Annotated[
        str | None, typer.Option("--env", help="The environment (default: the first that can read the instance).")
    ] = None,
    objective: options.Objective = None,
    view: options.View = "full",
    seed: options.Seed = 0,
    bound: Annotated[bool, typer.Option("--bound", help="Let a solver prove a bound, and tell the gap to it.")] = False,
    time_limit: Annotated[
        float | None, typer.Option("--time-limit", metavar="S", help="Wall seconds of a solver's run.")
    ] = None,
) -> None:
    """Schedule one instance: JSON and CSV for every scheduler, a chart as PNG, SVG and HTML, and what fails and why."""
    from marl_sched.cli.compilation import told_of_compilation
    from marl_sched.cli.selection import create_schedulers
    from marl_sched.files import write_json

    options.check_folder(out)
    domain, loaded = load_any(instance, env)
    schedules = require_schedules(domain)
    if bound and domain.solver_bound is None:
        raise InvalidOptionError(f"--bound: the environment {domain.name!r} has no solver that proves one")
    options.warn_of_impossible(domain, {str(instance): loaded})
    words = [name for group in scheduler for name in group.split(",")]
    players = create_schedulers(domain, words, time_limit, strict=not bound)
    own.words.setdefault(domain.unit, "1")
    problem = options.state_problem(
        domain.name, own, instances=[loaded], view=view, seed=seed, objective=objective, episodes=1
    )
    found, rows = {}, []
    with told_of_compilation():
        proved = domain.solver_bound(loaded, problem.objective, time_limit) if bound and domain.solver_bound else None
        for name, player in players.items():
            found[name], row = _play(problem, name, player, schedules, proved)
            rows.append(row)
    _tell(rows, found, schedules, proved)
    for name, data in found.items():
        stem = out / name.replace("/", "-")
        write_json(stem.with_name(stem.name + ".json"), data)
        _write_csv(stem.with_name(stem.name + ".csv"), *schedules.rows(data))
        typer.echo(stem.with_name(stem.name + ".json"))
        typer.echo(stem.with_name(stem.name + ".csv"))
    _draw(out, instance, found, rows, schedules, proved)


def _play(
    problem: Problem, name: str, player: Scheduler, schedules: Schedules, proved: Mapping[str, Any] | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The schedule of the first round by a scheduler, and what the table says of it."""
    from marl_sched.agents.playing import play
    from marl_sched.train.evaluation.evaluate import own_options

    simulator = problem.simulator([0], **own_options(player, problem))
    simulator.reset(seed=problem.seed, episodes=problem.episode_numbers([0]))
    started = time.perf_counter()
    play(player, simulator)
    seconds = time.perf_counter() - started
    data = schedules.of(simulator, 0, 0)
    row = {"scheduler": name, **schedules.summary(data)}
    value = float(simulator.per_round()[problem.objective][0, 0])
    row[problem.objective] = value if data["feasible"] else None
    if proved is not None:
        certain = proved["bound"] is not None and data["feasible"]
        row["bound"] = proved["bound"]
        row["gap %"] = 100 * (value - proved["bound"]) / max(proved["bound"], 1e-9) if certain else None
    row["seconds"] = seconds
    return data, row


def _tell(
    rows: list[dict[str, Any]],
    found: Mapping[str, dict[str, Any]],
    schedules: Schedules,
    proved: Mapping[str, Any] | None,
) -> None:
    from marl_sched.cli.tables import print_rows

    headings = list(rows[0])
    caption = "" if proved is None else f"bound: {proved['status']}, {proved['seconds']:.2f} s"
    print_rows(headings, [[_text(row[heading]) for heading in headings] for row in rows], caption=caption)
    for name, data in found.items():
        for sentence in schedules.explain(data):
            typer.echo(f"{name}: {sentence}")


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def _write_csv(path: Path, headings: list[str], rows: list[list[Any]]) -> None:
    from marl_sched.files import replacing

    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([headings, *rows])


def _draw(
    out: Path,
    instance: Path,
    found: Mapping[str, dict[str, Any]],
    rows: list[dict[str, Any]],
    schedules: Schedules,
    proved: Mapping[str, Any] | None,
) -> None:
    """Write the chart of all schedules in every format, and a page that needs nothing else."""
    from marl_sched.train.evaluation.html_page import Page
    from marl_sched.train.evaluation.plots import save

    figure = schedules.figure(found)
    for suffix in ("png", "svg"):
        typer.echo(save(figure, out / f"gantt.{suffix}"))
    page = Page(f"Schedules of {instance.name}")
    headings = list(rows[0])
    page.table(headings, [[_text(row[heading]) for heading in headings] for row in rows])
    if proved is not None:
        page.text(f"Bound: {proved['status']} after {proved['seconds']:.2f} s.")
    page.figure(figure)
    for name, data in found.items():
        page.heading(name)
        page.items(schedules.explain(data) or ["Every constraint holds."])
        columns, lines = schedules.rows(data)
        page.table(columns, [[_text(cell) for cell in line] for line in lines], folded="All tasks")
    typer.echo(page.save(out / "schedule.html"))


def validate(
    schedule: Annotated[Path, typer.Argument(metavar="SCHEDULE.json", help="As --save-schedules writes it.")],
) -> None:
    """Check a schedule by code that shares nothing with the simulator: 0 confirmed and feasible, 1 not."""
    from marl_sched.domain import domain_names, get_domain
    from marl_sched.errors import require
    from marl_sched.files import read_json

    data = read_json(schedule)
    if not isinstance(data, dict) or not isinstance(data.get("env"), str):
        raise InvalidFileError(schedule, "env", "the name of an environment; the field is missing")
    require("environment", data["env"], domain_names())
    schedules = require_schedules(get_domain(data["env"]))
    decoded = schedules.decode(data, schedule)
    problems = schedules.problems(decoded)
    for problem in problems:
        typer.echo(problem)
    if problems:
        typer.echo(f"{schedule}: {'refuted' if decoded['feasible'] else 'infeasible, as it says'}")
        raise typer.Exit(REFUTED)
    words = ", ".join(f"{name} {_text(value)}" for name, value in schedules.summary(decoded).items())
    typer.echo(f"{schedule}: confirmed, {words}")


def require_schedules(domain: Domain) -> Schedules:
    """What a domain declares of its schedules; InvalidOptionError if it has none."""
    if domain.schedules is None:
        raise InvalidOptionError(f"--env: the environment {domain.name!r} has no schedules")
    return domain.schedules


def load_any(path: Path, env: str | None, own: Mapping[str, str] | None = None) -> tuple[Domain, Any]:
    """An instance in any format, and the domain that reads it: `env`, or what the file says or is taken by first.

    `own` are texts of settings of a spreadsheet. Raises InvalidFileError where no domain can read it.
    """
    from marl_sched.cli.sheets import domain_of_sheet, load_sheet
    from marl_sched.domain import domain_names, get_domain
    from marl_sched.files import read_json

    if path.suffix.lower() == ".csv":
        domain = domain_of_sheet(path, env)
        return domain, load_sheet(domain, path, OwnOptions(own or {}))
    if env is None and path.suffix.lower() == ".json":
        data = read_json(path)
        said = data.get("env") if isinstance(data, dict) else None
        env = said if isinstance(said, str) and said in domain_names() else None
    if env is not None:
        return get_domain(env), get_domain(env).load(path)
    refused: MarlSchedError | None = None
    for domain in map(get_domain, domain_names()):
        try:
            return domain, domain.load(path)
        except MarlSchedError as error:
            refused = error
    raise refused or InvalidFileError(path, "", "an instance of an environment that is installed")

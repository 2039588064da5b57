"""`marl-sched tables`: the published tables made again, cell by cell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.train.published.cells import Job
    from marl_sched.train.published.entries import Untrained
    from marl_sched.train.published.store import Cells

FOLDER, QUICK_FOLDER = Path("docs/results"), Path("out/tables")
SAMPLE = 10  # cells that are played again where kernels have changed
UNTRAINED = 3  # exit code when the page is made, but lacks policies


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog=f"Example: marl-sched tables --env {options.DEFAULT_ENV} --quick --workers 2")(tables)


def tables(
    env: options.Env = options.DEFAULT_ENV,
    quick: Annotated[bool, typer.Option("--quick", help="Few instances and episodes, in a folder of its own.")] = False,
    render: Annotated[bool, typer.Option("--render", help="Only draw the page; play nothing.")] = False,
    without_policies: Annotated[
        bool, typer.Option("--without-policies", help="Only make the cells of rules and bounds; draw no page.")
    ] = False,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes that play, one thread each.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help=f"Folder (default {FOLDER}, with --quick {QUICK_FOLDER})."),
    ] = None,
) -> None:
    """Make the published tables again: play the cells that are missing, then draw the page from all cells.

    Run it at the root of a checkout. It can be stopped and started again; finished cells are kept. Ends with 3 if
    policies of the list are not trained yet; the page names them.
    """
    from marl_sched.train.published.entries import Entries
    from marl_sched.train.published.filling import missing
    from marl_sched.train.published.page import write_pages
    from marl_sched.train.published.plan import as_plan, shipped_list
    from marl_sched.train.published.store import Cells

    if render and without_policies:
        raise InvalidOptionError("--render, --without-policies: expected one of them, together nothing is left to do")
    out = out or (QUICK_FOLDER if quick else FOLDER)
    options.check_folder(out)
    given, where = shipped_list(env)
    if "comparisons" in given:
        _compare(given, where, out, workers, quick=quick, render=render)
        return
    plan = as_plan(given, where)
    entries = Entries(plan, plan.quick if quick else plan.full, Path())
    jobs, untrained = entries.all()
    cells = Cells(out / env / "cells.jsonl")
    if not render:
        _confirm(cells, jobs)
        chosen = [job for job in jobs if job.weights is None] if without_policies else jobs
        _fill(missing(chosen, cells), cells, workers)
    if without_policies:
        return
    command = f"marl-sched tables --env {env}" + (" --quick" if quick else "")
    for path in write_pages(entries, cells, command, out):
        typer.echo(path)
    _tell(untrained)


def _compare(given: dict[str, Any], where: str, out: Path, workers: int, *, quick: bool, render: bool) -> None:
    """The same for a list of comparisons: cells that are missing, then the page."""
    from marl_sched.files import replacing
    from marl_sched.train.published.comparison_page import page
    from marl_sched.train.published.comparisons import as_comparisons, make, missing, places, read_cells, write_cells
    from marl_sched.train.published.filling import worker_processes

    plan = as_comparisons(given, where)
    path = out / plan.env / "cells.jsonl"
    cells = read_cells(path)
    left = [] if render else missing(places(plan, quick=quick), cells)
    if left:
        with worker_processes(min(workers, len(left))) as pool:
            for place, cell in zip(left, pool.map(make, [place.inputs for place in left]), strict=True):
                cells[cell.inputs.name] = cell
                write_cells(path, cells)
                typer.echo(f"{place.entry.label}, {place.scale}: {cell.cpu_seconds:.1f} s of processor time", err=True)
    command = f"marl-sched tables --env {plan.env}" + (" --quick" if quick else "")
    text = page(plan, cells, command, quick=quick)
    with replacing(out / f"{plan.env}.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    typer.echo(out / f"{plan.env}.md")


def _confirm(cells: Cells, jobs: list[Job]) -> None:
    """Play some cells again where kernels have changed since they were made, and say what came of it."""
    from marl_sched.train.published.store import confirm

    stale = len(cells.stale())
    if not stale:
        return
    differing = confirm(cells, jobs, SAMPLE)
    if differing:
        typer.echo(f"the kernels score differently ({'; '.join(differing)}): {stale} cells are made again", err=True)
    else:
        typer.echo(f"{stale} cells of earlier kernels hold: {SAMPLE} of them were played again and agree", err=True)


def _fill(jobs: list[Job], cells: Cells, workers: int) -> None:
    """Make cells, with a bar where there is a terminal and a line for each that is finished."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from marl_sched.train.published.cells import describe
    from marl_sched.train.published.filling import fill, worker_processes

    if not jobs:
        return
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        work = progress.add_task("cells", total=len(jobs))
        with worker_processes(min(workers, len(jobs))) as pool:
            for done, (job, cell) in enumerate(fill(jobs, cells, pool), start=1):
                score = sum(cell.M1) / len(cell.M1)
                console.print(
                    f"{done}/{len(jobs)} {describe(job.inputs)}: M1 {score:.4f}, {cell.seconds:.0f} s",
                    highlight=False,
                    soft_wrap=True,
                )
                progress.update(work, completed=done)


def _tell(untrained: list[Untrained]) -> None:
    """Name the policies that are not there, and end with an exit code that says so if there are any."""
    for entry in untrained:
        how = f": {entry.command}" if entry.command else ""
        typer.echo(f"not trained yet: {entry.policy} ({entry.label}){how}", err=True)
    if untrained:
        raise typer.Exit(UNTRAINED)

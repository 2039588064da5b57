"""`marl-sched generate`: problem instances as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.domain import Domain


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog=f"Example: marl-sched generate {options.DEFAULT_ENV} --count 20 --seed 1 --out problems")(
        generate
    )


def generate(
    env: Annotated[str, typer.Argument(help="The environment.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write to.")],
    scale: options.Scale = None,
    count: Annotated[int, typer.Option("--count", min=1, help="How many instances.")] = 1,
    seed: options.Seed = 0,
    feasible: Annotated[
        bool,
        typer.Option("--feasible", help="Draw until a solver finds a feasible schedule."),
    ] = False,
) -> None:
    """Draw problem instances and write each to a JSON file of its own."""
    from marl_sched.domain import get_domain

    domain = _solvable(get_domain(env)) if feasible else get_domain(env)
    scale = domain.require_scale(scale or next(iter(domain.scales)))
    options.check_folder(out)
    for i, instance in enumerate(domain.instances(scale, count, seed)):
        path = (
            out / f"{env}-{scale}-{seed}-{i:04}.json"
        )  # as long whatever the count, or a second call would leave twins
        instance.save(path)
        options.warn_of_impossible(domain, {path.name: instance})
    typer.echo(f"{count} {scale} {env} instances in {out}")


def _solvable(domain: Domain) -> Domain:
    """A domain that generates only instances that its solver solves; InvalidOptionError if it needs none."""
    from marl_sched.agents.registry import feasibility

    draw, accept = domain.generate_accepted, feasibility(domain.name)
    if draw is None or accept is None:
        raise InvalidOptionError(f"--feasible: the environment {domain.name!r} has no infeasible instances")
    return replace(domain, generate=lambda scale, rng: draw(scale, rng, accept))

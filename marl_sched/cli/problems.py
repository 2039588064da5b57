"""`marl-sched generate`: problem instances as files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from marl_sched.cli import options


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog="Example: marl-sched generate airme --scale small --count 20 --seed 1 --out problems")(generate)


def generate(
    env: Annotated[str, typer.Argument(help="The environment.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write to.")],
    scale: options.Scale = "small",
    count: Annotated[int, typer.Option("--count", min=1, help="How many instances.")] = 1,
    seed: options.Seed = 0,
) -> None:
    """Draw problem instances and write each to a JSON file of its own."""
    from marl_sched.domain import get_domain

    domain = get_domain(env)
    domain.require_scale(scale)
    options.check_folder(out)
    digits = len(str(count - 1))
    for i, instance in enumerate(domain.instances(scale, count, seed)):
        instance.save(out / f"{env}-{scale}-{seed}-{i:0{digits}}.json")
    typer.echo(f"{count} {scale} {env} instances in {out}")

"""`marl-sched train` and `resume`: policies learn."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog="Example: marl-sched train env=airme view=local view.reach=1 algorithm=gae seed=1")(train)
    app.command(epilog="Example: marl-sched resume runs/airme-local")(resume)


def train(
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="KEY=VALUE...", help="Hydra overrides of configs/train.yaml.")
    ] = None,
) -> None:
    """Train a policy as configs/train.yaml says, with these overrides."""
    from marl_sched.train.run import train_from_overrides

    typer.echo(train_from_overrides(overrides or []))


def resume(run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="The folder of a run.")]) -> None:
    """Go on with a training run exactly where its last checkpoint left it."""
    from marl_sched.train.run import resume as go_on

    typer.echo(go_on(run_dir))

"""Options that several commands share, and how they become views and instances."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.errors import InvalidFileError, InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.agents.policies.cards import PolicyCard
    from marl_sched.domain import Domain

Env = Annotated[str, typer.Option("--env", help="The environment; `marl-sched list` shows all.")]
Scale = Annotated[str, typer.Option("--scale", help="Size of generated instances.")]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of instances and noise.")]
Hours = Annotated[int | None, typer.Option("--hours", min=1, help="airme: hours of an episode (default 720).")]
View = Annotated[str, typer.Option("--view", help="What an acting agent sees: full, local or (airme) random.")]
Reach = Annotated[
    int | None, typer.Option("--reach", metavar="R", help="view local: sectors seen either side (default 1).")
]
Comm = Annotated[
    float | None,
    typer.Option("--comm", metavar="C", help="view local: how far agents hear (airme: crews either side, default 1)."),
]
Staleness = Annotated[
    int | None, typer.Option("--staleness", metavar="H", help="view local: age of others' data (default 0).")
]
Sensing = Annotated[
    float | None, typer.Option("--sensing", metavar="D", help="murse, view local: how far agents see (default 4).")
]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the results here.")]

VIEW_OPTIONS = ("reach", "comm", "staleness", "sensing")
# Options that only some environments have: `Domain.cli_options` says which. Given to another one they are errors.
SIMULATOR_OPTIONS = ("hours", "rounds", "failure", "scheme", "mode", "durations", "proximity", "picking")


def build_view(domain: Domain, kind: str, options: Mapping[str, Any]) -> Any:
    """The domain's view of that kind with the options that are not None; raises as `Domain.view`."""
    return domain.view(kind, **_given(options))


def simulator_options(domain: Domain, options: Mapping[str, Any]) -> dict[str, Any]:
    """The simulator's arguments for the options that were given; InvalidOptionError for another domain's option."""
    given = _given(options)
    for name in given:
        if name not in domain.cli_options:
            raise InvalidOptionError(f"--{name}: the environment {domain.name!r} has no such option")
    return {domain.cli_options[name]: value for name, value in given.items()}


def load_instances(domain: Domain, source: str, scale: str, seed: int) -> tuple[list[Any], str | None]:
    """Instances and the scale that pads them: N generated ones of a scale, or all JSON files of a folder.

    A user's own instances are of no scale (None). Raises InvalidOptionError or InvalidFileError.
    """
    domain.require_scale(scale)
    if source.lstrip("-").isdigit():
        if int(source) < 1:
            raise InvalidOptionError(f"--instances: expected at least 1, got {source}")
        return domain.instances(scale, int(source), seed), scale
    folder = Path(source)
    if not folder.is_dir():
        raise InvalidOptionError(f"--instances: expected a number or a folder of instance files, got {source!r}")
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise InvalidFileError(folder, "", "at least one instance file (*.json)")
    return [domain.load(path) for path in paths], None


def warn_of_impossible(domain: Domain, instances: Mapping[str, Any]) -> None:
    """Say on stderr, in a line for each instance by its caption, why nothing can solve it, if that is known."""
    for caption, instance in instances.items():
        if reasons := domain.impossibilities(instance):
            typer.echo(f"warning: {caption}: no schedule can be feasible: {'; '.join(reasons)}", err=True)


def tell_of_training(name: str, card: PolicyCard | None, view: Any, objective: str) -> None:
    """Say on stderr if a policy was trained to see or to want something else than it is going to.

    `card` None: it is no trained policy. One that learned under random views is meant for every view.
    """
    if card is None:
        return
    from marl_sched.train.evaluation.evaluate import view_as_json

    trained, now = card.view, view_as_json(view)
    if trained != now and trained["kind"] != "random":
        typer.echo(f"note: {name} was trained for view {_words(trained)}, it plays with {_words(now)}", err=True)
    if card.objective != objective:
        typer.echo(f"note: {name} was trained for {card.objective}, it plays for {objective}", err=True)


def _words(view: Mapping[str, Any]) -> str:
    """`local (reach 1, comm 1, staleness 0)`."""
    details = ", ".join(f"{name} {value}" for name, value in view.items() if name != "kind")
    return f"{view['kind']} ({details})" if details else str(view["kind"])


def check_output(path: Path | None, option: str = "--json") -> None:
    """Refuse a file that could not be written, before the work is done for nothing."""
    if path is None:
        return
    if path.is_dir():
        raise InvalidOptionError(f"{option}: {path} is a folder, expected a file")
    check_folder(path.parent, option)


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a folder that is not there and cannot be made, or that nothing can be written into."""
    there = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise InvalidOptionError(f"{option}: {there} is not a folder")
    if not os.access(there, os.W_OK):
        raise InvalidOptionError(f"{option}: no permission to write in {there}")


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}

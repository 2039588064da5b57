"""Options that several commands share, and how they become views and instances."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from marl_sched.errors import InvalidFileError, InvalidOptionError, require

if TYPE_CHECKING:
    from marl_sched.domain import Domain

Env = Annotated[str, typer.Option("--env", help="The environment; `marl-sched list` shows all.")]
Scale = Annotated[str, typer.Option("--scale", help="Size of generated instances.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of instances and noise.")]
Hours = Annotated[int | None, typer.Option("--hours", min=1, help="airme: hours of an episode (default 720).")]
View = Annotated[str, typer.Option("--view", help="What an acting agent sees: full or local.")]
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
# Options that only some environments have: option -> environment -> the simulator's argument. Given to another
# environment an option is an error.
SIMULATOR_OPTIONS: Mapping[str, Mapping[str, str]] = {
    "hours": {"airme": "horizon"},
    "failure": {"airme": "failure"},
    "scheme": {"airme": "scheme"},
    "rounds": {"murse": "horizon"},
    "mode": {"murse": "mode"},
    "durations": {"murse": "durations"},
    "proximity": {"murse": "proximity"},
    "picking": {"murse": "picking"},
}


def build_view(domain: Domain, name: str, options: Mapping[str, Any]) -> Any:
    """The domain's view of that name with the options that were given; None means not given.

    Raises UnknownNameError for a view that the domain does not have and InvalidOptionError for an option that
    the view does not have.
    """
    kind = domain.views[require(f"view of {domain.name}", name, domain.views)]
    types = get_type_hints(kind)
    known = [field.name for field in fields(kind)]
    given = _given(options)
    for option, value in given.items():
        if option not in known:
            has = ", ".join(f"--{field}" for field in known) or "no options"
            raise InvalidOptionError(f"--{option}: the view {name!r} of {domain.name} has {has}")
        if types[option](value) != value:
            raise InvalidOptionError(f"--{option}: expected an integer, got {value}")
    return kind(**{option: types[option](value) for option, value in given.items()})


def simulator_options(domain: Domain, options: Mapping[str, Any]) -> dict[str, Any]:
    """The simulator's arguments for the options that were given; InvalidOptionError for another domain's option."""
    given = _given(options)
    for name in given:
        if domain.name not in SIMULATOR_OPTIONS[name]:
            raise InvalidOptionError(f"--{name}: the environment {domain.name!r} has no such option")
    return {SIMULATOR_OPTIONS[name][domain.name]: value for name, value in given.items()}


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

"""Options that several commands share, and how they become a problem."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli.grouped import OwnOptions
from marl_sched.envs import DOMAINS
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.files import STDOUT

if TYPE_CHECKING:
    from marl_sched.agents.policies.cards import PolicyCard
    from marl_sched.domain import Domain
    from marl_sched.problem import Problem

DEFAULT_ENV = next(iter(DOMAINS))

Env = Annotated[str, typer.Option("--env", help="The environment; `marl-sched list` shows all and their options.")]
Scale = Annotated[
    str | None, typer.Option("--scale", help="Size of generated instances (default: the environment's smallest).")
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of instances and noise.")]
Objective = Annotated[
    str | None, typer.Option("--objective", help="What M1 is the mean of (default: the environment's first).")
]
View = Annotated[
    str, typer.Option("--view", help="What an acting agent sees; its own options are options too, as in --reach 1.")
]
Instances = Annotated[
    str, typer.Option("--instances", metavar="N|PATH", help="How many to generate, an instance file, or a folder.")
]
JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json", metavar="FILE", help="Write the results here; - is standard output, the table then goes to stderr."
    ),
]
Format = Annotated[str, typer.Option("--format", help="Of the printed table: table, markdown, latex, csv or json.")]


def state_problem(
    env: str,
    own: OwnOptions,
    *,
    instances: str | Path | list[Any] | None = None,
    scale: str | None = None,
    view: str = "full",
    **arguments: Any,
) -> Problem:
    """The problem that words of the command line state.

    `instances` is how many to generate, a folder of instance files or one file, or a list of instances; None: one is
    generated.
    `own` holds the options that only this environment or this view has: the horizon by the name of its unit
    (`--hours 48`), the view's options, and the simulator's. Raises UnknownNameError for an option that nobody has.
    """
    from marl_sched.domain import get_domain
    from marl_sched.problem import Problem

    domain = get_domain(env)
    view_words: dict[str, Any] = {"kind": view}
    horizon, options = None, {}
    of_view = domain.view_options(view)
    for option, text in own.words.items():
        name = option.replace("-", "_")
        if option == domain.unit:
            horizon = _as_horizon(option, text)
        elif name in of_view:
            view_words[name] = as_value(text)
        elif name in domain.simulator_options:
            options[name] = as_value(text)
        else:
            known = [domain.unit, *of_view, *domain.simulator_options]
            names = [f"--{one.replace('_', '-')}" for one in known]
            raise UnknownNameError(f"option of {env} with view {view}", f"--{option}", [*names, *own.command])
    source = _source(domain, instances, scale)
    problem = Problem(domain, **source, horizon=horizon, view=view_words, options=options, **arguments)
    if horizon is not None and domain.longest is not None:
        longest = max(map(domain.longest, problem.instances))
        if horizon > longest:
            raise InvalidOptionError(f"--{domain.unit} {horizon}: the instances have {longest} {domain.unit} at most")
    return problem


def _as_horizon(option: str, text: str) -> int:
    value = as_value(text)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidOptionError(f"--{option}: expected an integer >= 1, got {text}")
    return value


def as_value(text: str) -> Any:
    """A word of the command line as an int, a float, true, false or null as JSON has them, else as it is."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False, "null": None}.get(text, text)


def _source(domain: Domain, instances: str | Path | list[Any] | None, scale: str | None) -> dict[str, Any]:
    """The problem's instances: so many of a scale, or files, which are of no scale."""
    if scale is not None:
        domain.require_scale(scale)
    if instances is None:
        return {"scale": scale, "count": 1}
    if isinstance(instances, Path | list):
        return {"instances": [instances] if isinstance(instances, Path) else instances}
    if instances.lstrip("-").isdigit():
        if int(instances) < 1:
            raise InvalidOptionError(f"--instances: expected at least 1, got {instances}")
        return {"scale": scale, "count": int(instances)}
    folder = Path(instances)
    if folder.is_file():
        return {"instances": [folder]}
    if not folder.is_dir():
        raise InvalidOptionError(
            f"--instances: expected a number, an instance file or a folder of them, got {instances!r}"
        )
    paths = domain.instance_files(folder)
    if not paths:
        raise InvalidFileError(folder, "", "at least one instance file")
    return {"instances": paths}


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
    from marl_sched.problem import view_as_json, view_in_words

    trained, now = card.view, view_as_json(view)
    if trained != now and trained["kind"] != "random":
        typer.echo(
            f"note: {name} was trained for view {view_in_words(trained)}, it plays with {view_in_words(now)}", err=True
        )
    if card.objective != objective:
        typer.echo(f"note: {name} was trained for {card.objective}, it plays for {objective}", err=True)


def check_output(path: Path | None, option: str = "--json") -> None:
    """Refuse a file that could not be written, before the work is done for nothing."""
    if path is None:
        return
    if path.is_dir():
        raise InvalidOptionError(f"{option}: {path} is a folder, expected a file")
    if path == STDOUT or (path.exists() and not path.is_file()):  # a device or a pipe is written through
        if path != STDOUT and not os.access(path, os.W_OK):
            raise InvalidOptionError(f"{option}: no permission to write to {path}")
        return
    check_folder(path.parent, option)


PICTURES = (".png", ".svg", ".pdf")


def check_picture(path: Path | None, option: str) -> None:
    """Refuse a picture that could not be written, or whose suffix is of no known format."""
    if path is not None and path.suffix.lower() not in PICTURES:
        raise InvalidOptionError(f"{option}: expected a name that ends in {', '.join(PICTURES)}, got {str(path)!r}")
    check_output(path, option)


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a folder that is not there and cannot be made, or that nothing can be written into."""
    there = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise InvalidOptionError(f"{option}: {there} is not a folder")
    if not os.access(there, os.W_OK):
        raise InvalidOptionError(f"{option}: no permission to write in {there}")

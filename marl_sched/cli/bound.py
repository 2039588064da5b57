"""`marl-sched bound`: what no scheduler can pass."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    import numpy as np


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog="Example: marl-sched bound --env airme --scale small --instances 20 --json bound.json")(bound)


def bound(
    env: options.Env = "airme",
    scale: options.Scale = "small",
    instances: Annotated[
        str, typer.Option("--instances", metavar="N|DIR", help="How many to generate, or a folder of instance files.")
    ] = "20",
    seed: options.Seed = 0,
    hours: options.Hours = None,
    objective: Annotated[
        str | None, typer.Option("--objective", help="What M1 is the mean of (default: the environment's first).")
    ] = None,
    failure: Annotated[str, typer.Option("--failure", help="airme: density as published, or hazard.")] = "density",
    price_vectors: Annotated[
        int, typer.Option("--price-vectors", min=1, help="Price vectors to share; one per instance is the tightest.")
    ] = 5,
    json: options.JsonFile = None,
) -> None:
    """Prove an upper bound on the M1 that any scheduler can reach, for every instance.

    The crews' constraint is relaxed at a price that varies over the episode; what remains is solved exactly,
    plane by plane. Takes a minute or so per price vector.
    """
    from marl_sched.domain import get_domain
    from marl_sched.files import write_json

    domain = get_domain(env)
    chosen = domain.require_objective(objective or domain.objectives[0])
    options.check_output(json)
    problems, padded_to = options.load_instances(domain, instances, scale, seed)
    relaxation, values = _prove(
        env,
        problems,
        price_vectors,
        objective=chosen,
        horizon=hours or domain.default_horizon,
        failure=failure,
    )
    result: dict[str, Any] = {
        "schema": 1,
        "env": env,
        "scale": padded_to,
        "objective": chosen,
        "failure": failure,
        "instances": len(problems),
        "hours": relaxation.horizon,
        "seed": seed,
        "price_vectors": min(price_vectors, len(problems)),
        "M1": {"mean": float(values.mean()), "std": float(values.std())},
        "per_instance": [float(value) for value in values],
    }
    if json is not None:
        write_json(json, result)
    typer.echo(_sentence(result))


def _prove(env: str, problems: list[Any], price_vectors: int, **settings: Any) -> tuple[Any, np.ndarray]:
    """The relaxation of a domain's problems and the bound of each, float64 (B,); a spinner tells how far it is."""
    from rich.console import Console

    package = f"marl_sched.agents.{env}.bound"
    if find_spec(package) is None:
        raise InvalidOptionError(f"--env: no bound is known for the environment {env!r}")
    bounds = import_module(f"{package}.relaxation")
    with Console(stderr=True).status("bounding") as status:
        relaxation = bounds.Relaxation(problems, **settings)
        found = bounds.upper_bounds(
            relaxation,
            price_vectors=price_vectors,
            progress=lambda done, total: status.update(f"price vector {done + 1} of {total}"),
        )
    return relaxation, found.value


def _sentence(result: dict[str, Any]) -> str:
    return (
        f"{result['env']}, {result['scale'] or 'given'} instances: no scheduler's expected M1 for "
        f"{result['objective']} passes {result['M1']['mean']:.4f} ± {result['M1']['std']:.4f} "
        f"({result['instances']} instances, {result['hours']} hours)"
    )

"""`marl-sched bound`: what no scheduler can pass."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.errors import InvalidOptionError


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
    from rich.console import Console

    from marl_sched.domain import get_domain
    from marl_sched.files import write_json

    domain = get_domain(env)
    module = f"marl_sched.agents.{env}_bound.relaxation"
    if find_spec(f"marl_sched.agents.{env}_bound") is None:
        raise InvalidOptionError(f"--env: no bound is known for the environment {env!r}")
    options.check_output(json)
    chosen = domain.require_objective(objective) if objective else domain.objectives[0]
    problems, padded_to = options.load_instances(domain, instances, scale, seed)
    bounds = import_module(module)
    with Console(stderr=True).status("bounding") as status:
        relaxation = bounds.Relaxation(
            problems, objective=chosen, horizon=hours or domain.default_horizon, failure=failure
        )
        found = bounds.upper_bounds(
            relaxation,
            price_vectors=price_vectors,
            progress=lambda done, total: status.update(f"price vector {done + 1} of {total}"),
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
        "M1": {"mean": float(found.value.mean()), "std": float(found.value.std())},
        "per_instance": [float(value) for value in found.value],
    }
    if json is not None:
        write_json(json, result)
    typer.echo(
        f"{env}, {padded_to or 'given'} instances: no scheduler's expected M1 for {chosen} passes "
        f"{result['M1']['mean']:.4f} ± {result['M1']['std']:.4f} "
        f"({len(problems)} instances, {relaxation.horizon} hours)"
    )

"""`marl-sched bound`: what no scheduler can pass."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, OwnOptions, takes
from marl_sched.errors import InvalidOptionError, require

if TYPE_CHECKING:
    import numpy as np

    from marl_sched.problem import Problem

SCHEMA = 2  # 1 named the horizon by its unit and had no other option of the simulator than `failure`


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    example = f"Example: marl-sched bound --env {options.DEFAULT_ENV} --scale small --instances 20 --json bound.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Bounded)(bound))


@dataclass(frozen=True, kw_only=True)
class Bounded:
    """The problem to be bounded; each field but `own` is an option."""

    env: options.Env = options.DEFAULT_ENV
    scale: options.Scale = None
    instances: options.Instances = "20"
    seed: options.Seed = 0
    objective: options.Objective = None
    own: OwnOptions

    def problem(self) -> Problem:
        """The problem that the words state."""
        return options.state_problem(
            self.env,
            self.own,
            instances=self.instances,
            scale=self.scale,
            seed=self.seed,
            objective=self.objective,
        )


def bound(
    bounded: Bounded,
    *,
    price_vectors: Annotated[
        int, typer.Option("--price-vectors", min=1, help="Price vectors to share; one per instance is the tightest.")
    ] = 5,
    json: options.JsonFile = None,
) -> None:
    """Prove a bound on the M1 that any scheduler can reach, for every instance.

    What couples the instance's parts is relaxed at a price that varies over the episode; what remains is solved
    exactly, part by part. Takes a minute or so per price vector.
    """
    from marl_sched.files import STDOUT, write_json

    options.check_output(json)
    problem = bounded.problem()
    values = _prove(problem, price_vectors)
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "env": problem.domain.name,
        "scale": problem.pad,
        "objective": problem.objective,
        "options": dict(problem.options),
        "instances": problem.count,
        "horizon": problem.horizon,
        "unit": problem.unit,
        "seed": problem.seed,
        "price_vectors": min(price_vectors, problem.count),
        "M1": {"mean": float(values.mean()), "std": float(values.std())},
        "per_instance": [float(value) for value in values],
    }
    typer.echo(_sentence(result), err=json == STDOUT)
    if json is not None:
        write_json(json, result)


def _prove(problem: Problem, price_vectors: int) -> np.ndarray:
    """The bound of each instance, float64 (B,); tells on stderr how far it is."""
    from marl_sched.cli.progress import progress

    if problem.domain.bound is None:
        raise InvalidOptionError(f"--env: no bound is known for the environment {problem.domain.name!r}")
    bounds = import_module(problem.domain.bound)
    known = inspect.signature(bounds.Relaxation).parameters
    for name in problem.options:
        require(f"option of the bound of {problem.domain.name}", name, known)
    with progress() as tell:
        relaxation = bounds.Relaxation(
            problem.instances, objective=problem.objective, horizon=problem.horizon, **problem.options
        )
        found = bounds.upper_bounds(
            relaxation,
            price_vectors=price_vectors,
            progress=lambda done, total: tell("bounding", done / total),
        )
    return found.value


def _sentence(result: dict[str, Any]) -> str:
    return (
        f"{result['env']}, {result['scale'] or 'given'} instances: no scheduler's expected M1 for "
        f"{result['objective']} passes {result['M1']['mean']:.4f} ± {result['M1']['std']:.4f} "
        f"({result['instances']} instances, {result['horizon']} {result['unit']})"
    )

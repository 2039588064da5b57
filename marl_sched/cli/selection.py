"""What `evaluate` and `compare` are asked for: which schedulers play which episodes of which problems."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import OwnOptions
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.agents.base import Scheduler
    from marl_sched.domain import Domain
    from marl_sched.problem import Problem


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The selectors as they were typed; each field but `own` is an option of the command line."""

    schedulers: Annotated[
        str,
        typer.Option("--schedulers", metavar="A,B,C", help="Rules and shipped policies by name, checkpoints by path."),
    ] = ""
    scheduler: Annotated[
        list[str] | None,
        typer.Option("--scheduler", metavar="NAME", help="One more, also package.module:factory; may be repeated."),
    ] = None
    env: options.Env = options.DEFAULT_ENV
    scale: options.Scale = None
    instances: options.Instances = "100"
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes of each instance.")] = 10
    seed: options.Seed = 0
    objective: options.Objective = None
    baseline: Annotated[
        str | None,
        typer.Option(
            "--baseline",
            help="The one of --schedulers that paired differences are taken to, under the same view "
            "(default: what M2 is the gain over, with the full view).",
        ),
    ] = None
    view: options.View = "full"
    own: OwnOptions

    def resolve(self) -> Resolved:
        """The objects that the words stand for, or an error that says which word is wrong."""
        from marl_sched.domain import get_domain

        names = [*self.schedulers.split(","), *(self.scheduler or [])]
        schedulers = create_schedulers(get_domain(self.env), names)
        problem = options.state_problem(
            self.env,
            self.own,
            instances=self.instances,
            scale=self.scale,
            view=self.view,
            episodes=self.episodes,
            seed=self.seed,
            objective=self.objective,
        )
        for name, scheduler in schedulers.items():
            options.tell_of_training(name, getattr(scheduler, "card", None), problem.view, problem.objective)
        captions = {f"instance {i}": instance for i, instance in enumerate(problem.instances)}
        options.warn_of_impossible(problem.domain, captions)
        return Resolved(problem, schedulers)


@dataclass(frozen=True)
class Resolved:
    """A selection as objects."""

    problem: Problem
    schedulers: dict[str, Scheduler]


def create_schedulers(domain: Domain, names: Iterable[str]) -> dict[str, Scheduler]:
    """The schedulers by the names that were typed, in their order; InvalidOptionError if there is none."""
    from marl_sched.agents.registry import create_scheduler

    typed = [name.strip() for name in names if name.strip()]
    if not typed:
        raise InvalidOptionError("--schedulers: expected at least one name")
    return {name: create_scheduler(name, domain) for name in typed}

"""What `evaluate` and `compare` are asked for: which schedulers play which episodes of which problems."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.agents.base import Scheduler
    from marl_sched.domain import Domain
    from marl_sched.train.evaluation.evaluate import Settings


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The selectors as they were typed; each field is an option of the command line."""

    schedulers: Annotated[
        str,
        typer.Option("--schedulers", metavar="A,B,C", help="Rules and shipped policies by name, checkpoints by path."),
    ]
    env: options.Env = "airme"
    scale: options.Scale = "small"
    instances: Annotated[
        str,
        typer.Option("--instances", metavar="N|DIR", help="How many to generate, or a folder of instance files."),
    ] = "100"
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes of each instance.")] = 10
    seed: options.Seed = 0
    hours: options.Hours = None
    objective: Annotated[
        str | None, typer.Option("--objective", help="What M1 is the mean of (default: the environment's first).")
    ] = None
    baseline: Annotated[
        str | None,
        typer.Option(
            "--baseline",
            help="The one of --schedulers that paired differences are taken to, under the same view "
            "(default: what M2 is the gain over, with the full view).",
        ),
    ] = None
    view: options.View = "full"
    reach: options.Reach = None
    comm: options.Comm = None
    staleness: options.Staleness = None
    sensing: options.Sensing = None
    failure: Annotated[str | None, typer.Option("--failure", help="airme: density as published, or hazard.")] = None
    scheme: Annotated[str | None, typer.Option("--scheme", help="airme: full, skip or single.")] = None
    rounds: Annotated[int | None, typer.Option("--rounds", min=1, help="murse: rounds of an episode.")] = None
    mode: Annotated[str | None, typer.Option("--mode", help="murse: plan or online.")] = None
    durations: Annotated[str | None, typer.Option("--durations", help="murse: deterministic or stochastic.")] = None
    proximity: Annotated[str | None, typer.Option("--proximity", help="murse: distance, location or none.")] = None
    picking: Annotated[str | None, typer.Option("--picking", help="murse: which free agent decides first.")] = None

    def resolve(self) -> Resolved:
        """The objects that the words stand for, or an error that says which word is wrong."""
        from marl_sched.domain import get_domain
        from marl_sched.train.evaluation.evaluate import Settings

        domain = get_domain(self.env)
        words = asdict(self)
        own = options.simulator_options(domain, {name: words[name] for name in options.SIMULATOR_OPTIONS})
        settings = Settings(
            episodes=self.episodes,
            seed=self.seed,
            objective=domain.require_objective(self.objective) if self.objective else None,
            horizon=own.pop("horizon", None),
            view=options.build_view(domain, self.view, {name: words[name] for name in options.VIEW_OPTIONS}),
            options=own,
        )
        schedulers = create_schedulers(domain, self.schedulers)
        objective = str(settings.filled_in(domain).objective)
        for name, scheduler in schedulers.items():
            options.tell_of_training(name, getattr(scheduler, "card", None), settings.view, objective)
        instances, scale = options.load_instances(domain, self.instances, self.scale, self.seed)
        options.warn_of_impossible(domain, {f"instance {i}": instance for i, instance in enumerate(instances)})
        return Resolved(domain, schedulers, instances, replace(settings, scale=scale))


@dataclass(frozen=True)
class Resolved:
    """A selection as objects."""

    domain: Domain
    schedulers: dict[str, Scheduler]
    instances: list[Any]
    settings: Settings


def create_schedulers(domain: Domain, names: str) -> dict[str, Scheduler]:
    """The schedulers of a comma-separated list, by the names that were typed, in their order."""
    from marl_sched.agents.registry import create_scheduler

    typed = [name.strip() for name in names.split(",") if name.strip()]
    if not typed:
        raise InvalidOptionError("--schedulers: expected at least one name")
    return {name: create_scheduler(name, domain) for name in typed}

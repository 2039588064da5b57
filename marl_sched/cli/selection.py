"""What `evaluate` and `compare` are asked for: which schedulers play which episodes of which problems."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import OwnOptions
from marl_sched.errors import InvalidOptionError, require

if TYPE_CHECKING:
    from marl_sched.agents.base import Scheduler
    from marl_sched.domain import Domain
    from marl_sched.problem import Problem


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The selectors as they were typed; each field but `own` is an option of the command line."""

    schedulers: Annotated[
        str,
        typer.Option(
            "--schedulers",
            metavar="A,B,C",
            help="Rules and shipped policies by name, checkpoints by path. NAME@OPTION=VALUE sets a rule's option.",
        ),
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
    time_limit: Annotated[
        float | None,
        typer.Option("--time-limit", metavar="S", help="Wall seconds of a solver's run (default: its own limit)."),
    ] = None
    own: OwnOptions

    def resolve(self) -> Resolved:
        """The objects that the words stand for, or an error that says which word is wrong."""
        from marl_sched.domain import get_domain

        names = [*self.schedulers.split(","), *(self.scheduler or [])]
        schedulers = create_schedulers(get_domain(self.env), names, self.time_limit)
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
        files = problem.files or (None,) * problem.count
        captions = {
            f"instance {i}" if file is None else str(file): instance
            for i, (file, instance) in enumerate(zip(files, problem.instances, strict=True))
        }
        options.warn_of_impossible(problem.domain, captions)
        return Resolved(problem, schedulers)


@dataclass(frozen=True)
class Resolved:
    """A selection as objects."""

    problem: Problem
    schedulers: dict[str, Scheduler]


def create_schedulers(
    domain: Domain, names: Iterable[str], time_limit: float | None = None, *, strict: bool = True
) -> dict[str, Scheduler]:
    """The schedulers by the words that were typed, in their order; InvalidOptionError if there is none.

    A word is a name and, each behind an `@`, options of that scheduler: `lst-search@evaluations=32`. `time_limit`
    goes to those that have such an option and were not given another one; if `strict`, one of them must have it.
    """
    from marl_sched.agents.registry import create_scheduler

    typed = [name.strip() for name in names if name.strip()]
    if not typed:
        raise InvalidOptionError("--schedulers: expected at least one name")
    schedulers: dict[str, Scheduler] = {}
    limited = 0
    for word in typed:
        name, *pairs = word.split("@")
        known = scheduler_options(domain, name) + (planner_options(domain, name) if pairs else [])
        given = dict(_option(word, pair, known) for pair in pairs)
        if time_limit is not None and "time_limit" in known:
            given.setdefault("time_limit", time_limit)
            limited += 1
        schedulers[word] = create_scheduler(name, domain, **given)
    if strict and time_limit is not None and not limited:
        raise InvalidOptionError(f"--time-limit: none of {', '.join(typed)} has a limit")
    return schedulers


def scheduler_options(domain: Domain, name: str) -> list[str]:
    """The options that a scheduler can be given by name: a rule's own; of a policy `samples`, where there is that."""
    from marl_sched.agents.registry import rules

    factory = rules(domain).get(name)
    if factory is None:
        return [] if domain.best_of is None else ["samples"]
    parameters = inspect.signature(factory).parameters.values()
    return [one.name for one in parameters if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]


def planner_options(domain: Domain, name: str) -> list[str]:
    """The further options of a trained policy that plans whole rounds; none of other schedulers."""
    from marl_sched.agents.networks.registry import config_of_card
    from marl_sched.agents.registry import card_of

    card = card_of(name, domain)
    return [] if card is None else list(config_of_card(card.sizes).planner_options)


def _option(word: str, pair: str, known: list[str]) -> tuple[str, Any]:
    name, equals, text = pair.partition("=")
    name = name.replace("-", "_")
    if not equals:
        raise InvalidOptionError(f"{word}: expected @option=value, got @{pair}")
    return require(f"option of scheduler {word.partition('@')[0]}", name, known), options.as_value(text)

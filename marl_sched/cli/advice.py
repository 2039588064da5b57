"""`marl-sched advise`: the next decisions for a problem as it stands, why, and what the time to come looks like."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, OwnOptions, takes_own
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.agents.base import Scheduler
    from marl_sched.domain import Domain
    from marl_sched.planning import Advice
    from marl_sched.problem import Problem
    from marl_sched.train.evaluation.advice import Decision, Futures

SCHEMA = 1
_LISTED = 4  # candidates of an agent that the terminal shows
_CHANGE = re.compile(r"[+-]\d+")


@dataclass(frozen=True)
class Variant:
    """One of the compared ways to go on."""

    name: str
    problem: Problem
    scheduler: Scheduler


def add_to(app: typer.Typer) -> None:
    """Register this file's command."""
    example = "Example: marl-sched advise fleet.json --scheduler condition,index --crews +1 --html advice.html"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes_own(advise))


def advise(
    own: OwnOptions,
    instance: Annotated[Path, typer.Argument(metavar="INSTANCE", help="In any format that has a loader, or a CSV.")],
    scheduler: Annotated[
        str, typer.Option("--scheduler", metavar="A,B", help="Who advises; the others are compared with the first.")
    ],
    env: Annotated[
        str | None, typer.Option("--env", help="The environment (default: the first that can read the instance).")
    ] = None,
    objective: options.Objective = None,
    view: Annotated[
        str | None, typer.Option("--view", help="What agents see (default: what the policy was trained for, or full).")
    ] = None,
    seed: options.Seed = 0,
    futures: Annotated[int, typer.Option("--futures", min=2, help="Simulated futures.")] = 100,
    ahead: Annotated[
        int | None, typer.Option("--ahead", min=1, help="How many days, or rounds, to look ahead.")
    ] = None,
    json: options.JsonFile = None,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="A page with pictures that needs nothing else.")
    ] = None,
) -> None:
    """Say what every free agent should do now and why, and what the time to come looks like; what if by --NAME +1."""
    from marl_sched.cli.compilation import told_of_compilation
    from marl_sched.files import STDOUT, write_json

    options.check_output(json)
    options.check_output(html, "--html")
    variants, advice = _variants(own, instance, scheduler, env, objective, view, seed, ahead)
    steps = advice.steps if ahead is None else ahead
    with told_of_compilation():
        now, found = _work_out(variants, advice, futures, steps)
    data = _as_json(instance, variants, advice, now, found)
    _print(data, stderr=json == STDOUT)  # first: what was computed is seen, whatever the disk says
    if json is not None:
        write_json(json, data)
    if html is not None:
        from marl_sched.train.evaluation.advice_page import advice_page

        simulators = {name: one.simulator for name, one in found.items()}
        row = found[variants[0].name].median_row  # the same future for all
        typer.echo(advice_page(data, advice, simulators, row).save(html), err=json == STDOUT)


def _variants(
    own: OwnOptions,
    instance: Path,
    names: str,
    env: str | None,
    objective: str | None,
    view: str | None,
    seed: int,
    ahead: int | None,
) -> tuple[list[Variant], Advice]:
    """What is compared, the base first: each scheduler, and the first one under each what-if."""
    from marl_sched.cli.schedules import load_any
    from marl_sched.cli.selection import create_schedulers

    changes = {name: own.words.pop(name) for name, text in list(own.words.items()) if _CHANGE.fullmatch(text)}
    domain, loaded = _loaded(own, instance, env, load_any)
    if domain.advice is None:
        raise InvalidOptionError(f"--env: the environment {domain.name!r} gives no advice")
    advice = domain.advice
    players = create_schedulers(domain, names.split(","))
    if ahead is not None and domain.unit not in own.words and ahead * advice.step[1] > domain.default_horizon:
        own.words[domain.unit] = str(ahead * advice.step[1])

    def problem_of(changed: Any, player: Scheduler) -> Problem:
        card = getattr(player, "card", None)
        problem = options.state_problem(
            domain.name, own, instances=[changed], view=view or "full", seed=seed, objective=objective, episodes=1
        )
        return problem if view is not None or card is None else problem.but(view=card.view)

    variants = [Variant(name, problem_of(loaded, player), player) for name, player in players.items()]
    first = variants[0]
    for name, text in changes.items():
        setting = next((one for one in (domain.sheet.settings if domain.sheet else ()) if one.name == name), None)
        if setting is None or setting.changes is None or setting.of is None:
            known = [f"--{one.name}" for one in (domain.sheet.settings if domain.sheet else ()) if one.changes]
            raise InvalidOptionError(f"--{name} {text}: expected a what-if of {', '.join(known) or 'nothing'}")
        value = setting.of(loaded) + int(text)
        if value < 1:
            raise InvalidOptionError(f"--{name} {text}: expected at least 1 left, got {value}")
        changed = setting.changes(loaded, value)
        again = create_schedulers(domain, [first.name])[first.name]
        variants.append(Variant(f"{first.name}, {name} {text}", problem_of(changed, again), again))
    return variants, advice


def _loaded(own: OwnOptions, path: Path, env: str | None, load_any: Any) -> tuple[Domain, Any]:
    """The instance; what is given of a sheet's settings is taken out of the options, and a number given changes it."""
    from marl_sched.cli.sheets import domain_of_sheet
    from marl_sched.sheet_reading import read_settings

    if path.suffix.lower() == ".csv":
        sheet = domain_of_sheet(path, env).sheet
        known = [one.name for one in sheet.settings] if sheet else []
        given = {name: own.words.pop(name) for name in known if name in own.words}
        found: tuple[Domain, Any] = load_any(path, env, given)
        return found
    domain, loaded = load_any(path, env)
    for one in domain.sheet.settings if domain.sheet else ():
        if one.changes is not None and one.name in own.words:
            loaded = one.changes(loaded, read_settings(domain.sheet, {one.name: own.words.pop(one.name)})[one.name])
    return domain, loaded


def _work_out(
    variants: list[Variant], advice: Advice, count: int, steps: int
) -> tuple[dict[str, list[Decision]], dict[str, Futures]]:
    from marl_sched.agents.registry import create_scheduler
    from marl_sched.train.evaluation.advice import decide_now, play_futures

    now, found = {}, {}
    for one in variants:
        appraiser = create_scheduler(advice.appraiser, one.problem.domain)
        now[one.name] = decide_now(one.problem, one.scheduler, appraiser, advice)
        found[one.name] = play_futures(one.problem, one.scheduler, advice, count=count, steps=steps)
    return now, found


def _as_json(
    instance: Path,
    variants: list[Variant],
    advice: Advice,
    now: Mapping[str, list[Decision]],
    found: Mapping[str, Futures],
) -> dict[str, Any]:
    import marl_sched
    from marl_sched.problem import view_as_json
    from marl_sched.train.evaluation.advice import BAND, compare_futures

    base, *others = variants
    problem = base.problem
    return {
        "schema": SCHEMA,
        "version": marl_sched.__version__,
        "env": problem.domain.name,
        "instance": str(instance),
        "objective": problem.objective,
        "seed": problem.seed,
        "options": dict(problem.options),
        "futures": len(next(iter(found[base.name].totals.values()))),
        "band": BAND,
        "step": {"name": advice.step[0], advice.step[0]: advice.step[1], "unit": problem.unit},
        "base": base.name,
        "variants": {
            one.name: {
                "view": view_as_json(one.problem.view),
                "now": [_decision(decision) for decision in now[one.name]],
                "ahead": found[one.name].bands(),
            }
            for one in variants
        },
        "what_if": {one.name: compare_futures(found[base.name], found[one.name]) for one in others},
    }


def _decision(of: Decision) -> dict[str, Any]:
    return {
        "agent": of.agent,
        "action": of.chosen.action,
        "choice": of.chosen.name,
        "taken": of.taken,
        "worths": of.meaning or None,
        "candidates": [
            {"action": one.action, "choice": one.name, "worth": one.worth, "first": one.first, **one.facts}
            for one in of.candidates
        ],
    }


def _print(data: Mapping[str, Any], *, stderr: bool) -> None:
    """The advice of the base, what its time to come looks like, and what the other variants would change."""
    from marl_sched.cli.tables import print_rows
    from marl_sched.train.evaluation.advice_page import ahead_rows, now_rows, what_if_rows

    base = data["variants"][data["base"]]
    meaning = base["now"][0]["worths"] if base["now"] else None
    caption = "nobody is free now" if not base["now"] else f"in brackets: {meaning}" if meaning else ""
    print_rows(*now_rows(base["now"], _LISTED), title=f"now, by {data['base']}", caption=caption, stderr=stderr)
    caption = f"median [band of {100 * data['band']:.0f} percent] of {data['futures']} futures"
    print_rows(*ahead_rows(base["ahead"], data["step"]["name"]), title="ahead", caption=caption, stderr=stderr)
    if data["what_if"]:
        caption = f"differences to {data['base']} per {data['step']['name']}, in the same futures"
        print_rows(*what_if_rows(data["what_if"]), title="what if", caption=caption, stderr=stderr)

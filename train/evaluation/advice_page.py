"""Advice as rows of tables, and as a page with pictures that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from marl_sched.planning import Advice
from marl_sched.train.evaluation.bands import band_figure
from marl_sched.train.evaluation.html_page import Page

_SHOWN = 3  # variants whose timelines the page shows
_LISTED = 3  # candidates beside the chosen one


def now_rows(decisions: Sequence[Mapping[str, Any]], listed: int) -> tuple[list[str], list[list[str]]]:
    """Who does what now, and the best of what else it could do."""
    rows = []
    for decision in decisions:
        chosen, *others = decision["candidates"]
        words = [_candidate(one) for one in others[:listed]]
        taken = ", but somebody unheard took it" if decision["taken"] else ""
        rows.append([decision["agent"], _candidate(chosen) + taken, ", ".join(words)])
    return ["agent", "does", "instead of"], rows


def _candidate(one: Mapping[str, Any]) -> str:
    if one["worth"] is None:
        return str(one["choice"])
    return f"{one['choice']} [{'first, ' if one['first'] else ''}{number(one['worth'])}]"


def candidate_rows(decision: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Everything that an agent could do now, with what is known of it, best first."""
    known = {"action", "choice", "worth", "first"}
    facts = list(dict.fromkeys(name for one in decision["candidates"] for name in one if name not in known))
    rows = []
    for one in decision["candidates"]:
        worth = "" if one["worth"] is None else f"{'first, ' if one['first'] else ''}{number(one['worth'])}"
        rows.append([str(one["choice"]), worth, *(number(one.get(fact)) for fact in facts)])
    return ["choice", "worth", *facts], rows


def ahead_rows(bands: Mapping[str, Sequence[Mapping[str, Any]]], step: str) -> tuple[list[str], list[list[str]]]:
    """A row per step, a column per measure: median and band."""
    count = len(next(iter(bands.values())))
    rows = [[f"{step} {i + 1}", *(_band(steps[i]) for steps in bands.values())] for i in range(count)]
    return [step, *bands], rows


def what_if_rows(variants: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> tuple[list[str], list[list[str]]]:
    """A row per variant and measure: what it has more than the base."""
    rows = [
        [
            name,
            measure,
            _band(of),
            "" if of["mean"] is None else f"{of['mean']:+.4g} ({number(of['standard_error'])})",
            "" if of["better_share"] is None else f"{100 * of['better_share']:.0f} %",
        ]
        for name, measures in variants.items()
        for measure, of in measures.items()
    ]
    return ["what if", "measure", "median [band]", "mean (standard error)", "better in"], rows


def _band(of: Mapping[str, Any]) -> str:
    if of["median"] is None:
        return "none"
    return f"{number(of['median'])} [{number(of['low'])}, {number(of['high'])}]"


def number(value: Any) -> str:
    """A number in four digits, anything else as it is, nothing for None."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def advice_page(data: Mapping[str, Any], advice: Advice, simulators: Mapping[str, Any], row: int) -> Page:
    """The page of `marl-sched advise`: decisions, why, the time to come, what if, and a timeline of the median future.

    `simulators` hold the played futures of each variant, of which number `row` is drawn.
    """
    step, base = data["step"], data["base"]
    page = Page(f"Advice for {data['instance']}")
    page.text(
        f"{data['env']}, by {base}, for {data['objective']}; {data['futures']} simulated futures, seed {data['seed']}; "
        f"marl-sched {data['version']}",
        note=True,
    )
    for name, variant in data["variants"].items():
        page.heading(f"Now, by {name}")
        if not variant["now"]:
            page.text("Nobody is free now.")
            continue
        page.table(*now_rows(variant["now"], _LISTED))
        for decision in variant["now"] if name == base else ():
            headings, rows = candidate_rows(decision)
            page.table(headings, rows, chosen=0, folded=f"Why: everything that {decision['agent']} could do")
        if variant["now"][0]["worths"]:
            page.text(f"Worth: {variant['now'][0]['worths']}; each agent decides after those above it.", note=True)
    page.heading(f"The next {len(next(iter(data['variants'][base]['ahead'].values())))} {step['name']}s")
    ahead = {name: variant["ahead"] for name, variant in data["variants"].items()}
    page.figure(band_figure(ahead, step=step["name"], band=data["band"]))
    page.table(*ahead_rows(ahead[base], step["name"]))
    page.text(f"Median and band of {100 * data['band']:.0f} percent of the futures, by {base}.", note=True)
    if data["what_if"]:
        page.heading("What if")
        page.table(*what_if_rows(data["what_if"]))
        page.text(f"Differences to {base} per {step['name']}, future by future with the same noise.", note=True)
    page.heading("One future")
    page.text(
        "Of each variant the future whose first measure is the median of all; it will not come like this.", note=True
    )
    until = step[step["name"]] * len(next(iter(ahead[base].values())))
    for name in list(simulators)[:_SHOWN]:
        page.figure(advice.figure({name: simulators[name]}, until, row))
    return page

"""Results as tables on a terminal, drawn from the same JSON that files hold."""

from __future__ import annotations

import textwrap
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

_WIDE = 110  # columns of a terminal
_ALWAYS = ("feasible",)  # without which M1 says little
_NAME_WIDTH = 24  # columns for a scheduler's name and what is said of it
_LARGE = 10  # from here on a decimal is enough


def print_scores(results: dict[str, Any]) -> None:
    """The table of `marl-sched evaluate`: a row per scheduler, best mean first; a narrow terminal gets less of it."""
    console = Console()
    measures = [name for name in _other_measures(results) if console.width >= _WIDE or name in _ALWAYS]
    table = Table(title=_title(results), caption=_caption(results), show_lines=False, box=box.SIMPLE_HEAD)
    table.add_column("scheduler", no_wrap=True)
    gain = ["M2 %"] if "reference" in results else []
    for heading in ("M1", "IQM", "difference", *gain, *measures):
        table.add_column(heading, justify="right", min_width=7, overflow="fold")
    lower = results["better"] == "lower"
    for name, row in sorted(results["schedulers"].items(), key=lambda item: item[1]["M1"]["mean"], reverse=not lower):
        m1, difference = row["M1"], row["difference"]
        cells = [
            f"{_number(m1['mean'], 4)}\n{_spread(m1)}",
            f"{_number(m1['iqm'], 4)}\n{_intervals(m1)}",
            f"{_number(difference['mean'], 4, '+')}\n{_intervals(difference)}",
        ]
        cells += [f"{row[name]['mean']:.1f}\n{_spread(row[name], 1)}" for name in ("M2",) if gain]
        cells += [f"{_number(row[measure]['mean'], 4)}\n{_spread(row[measure])}" for measure in measures]
        table.add_row("\n".join([name, *_notes(results, row)]), *cells)
    console.print(table)


def _notes(results: dict[str, Any], row: dict[str, Any]) -> list[str]:
    """What stands below a scheduler's name: what it needs, and whether a local view showed too much to be one."""
    notes = [f"({row['needs']})"] if row["needs"] else []
    if results["view"]["kind"] != "full" and not row["local"]:
        notes.append(f"(sees {100 * row['visible_share']:.0f} %: not local)")
    return [line for note in notes for line in textwrap.wrap(note, _NAME_WIDTH)]


def _title(results: dict[str, Any]) -> str:
    scale = results["scale"] or "given"
    return f"{results['env']}, {scale} instances: M1 is mean {results['objective']} over {horizon(results)}"


def horizon(results: dict[str, Any]) -> str:
    """What an episode lasts: `720 hours`."""
    return f"{results['horizon']} {results['unit']}"


def _caption(results: dict[str, Any]) -> str:
    view = dict(results["view"])
    kind, share, local = view.pop("kind"), view.pop("visible_share"), view.pop("local")
    seen = " ".join([kind, *(f"{name} {value}" for name, value in view.items())])
    baseline = results["baseline"]
    return (
        f"{results['instances']} instances x {results['episodes']} episodes, seed {results['seed']}; view {seen}, "
        f"{100 * share:.0f} % of the graph seen{'' if local or kind == 'full' else ', too much to be local'}. "
        f"difference: paired, to {baseline['scheduler']} with the {baseline['view']['kind']} view. "
        "±: over instances; 95 percent intervals: [ ] over such instances, ( ) over other noise on these instances"
    )


def print_bench(figures: dict[str, Any]) -> None:
    """The figures of `marl-sched bench`, each with what it is of."""
    title = f"{figures['env']}: {figures['threads']} thread, {figures['statistic']} ({figures['repeats']})"
    table = Table("figure", "value", "of", title=title, box=box.SIMPLE_HEAD)
    for name, meaning in figures["meaning"].items():
        value = figures[name]
        parts = (
            {f"{name} {part}": number for part, number in value.items()} if isinstance(value, dict) else {name: value}
        )
        for label, number in parts.items():
            table.add_row(label, f"{number:,.2f}", meaning)
    Console().print(table)


def _other_measures(results: dict[str, Any]) -> list[str]:
    row = next(iter(results["schedulers"].values()))
    known = ("M1", "M2", "difference", results["objective"])
    return [name for name, value in row.items() if isinstance(value, dict) and "std" in value and name not in known]


def _intervals(of: dict[str, Any]) -> str:
    """The interval over such instances in brackets, over the noise of these instances in parentheses."""
    such, these = of["ci95_such_instances"], of["ci95_these_instances"]
    lines = [f"[{_number(such[0], 3)}, {_number(such[1], 3)}]"] if such else []
    lines += [f"({_number(these[0], 3)}, {_number(these[1], 3)})"] if these else []
    return "\n".join(lines)


def _spread(of: dict[str, Any], decimals: int = 3) -> str:
    return "one instance" if of["std"] is None else f"± {_number(of['std'], decimals)}"


def _number(value: float, decimals: int, sign: str = "") -> str:
    """A score with its decimals: shares need them, makespans do not."""
    return f"{value:{sign}.{1 if abs(value) >= _LARGE else decimals}f}"

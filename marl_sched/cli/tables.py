"""Results as tables on a terminal, drawn from the same JSON that files hold."""

from __future__ import annotations

import csv
import json
import sys
import textwrap
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tabulate import tabulate

from marl_sched.errors import require

_WIDE = 110  # columns of a terminal
_ALWAYS = ("feasible",)  # without which M1 says little
_OF_SOLVERS = ("bound", "optimal", "timed_out", "without_plan")  # told by round, without a spread over instances
_NAME_WIDTH = 24  # columns for a scheduler's name and what is said of it
_SHORTEST_NAME = 12  # columns that a name keeps on a narrow terminal
FORMATS = ("table", "markdown", "latex", "csv", "json")
_LARGE = 10  # from here on a decimal is enough


def print_scores(results: dict[str, Any], style: str = "table", *, stderr: bool = False) -> None:
    """The scores of `marl-sched evaluate`, best mean first, to standard output or standard error.

    Styles: `table` for a terminal (a narrow one gets fewer measures, then shorter names, but never a number less),
    `markdown` and `latex` with all measures, `csv` with a column for every number, and `json`, the results. Raises
    UnknownNameError for another style.
    """
    require("format", style, FORMATS)
    file = sys.stderr if stderr else sys.stdout
    if style == "table":
        _print_table(results, Console(stderr=stderr))
        return
    if style == "json":
        file.write(json.dumps(results, indent=2, allow_nan=False) + "\n")
        return
    if style == "csv":
        rows = [_flat_row(results, name, row) for name, row in _best_first(results)]
        columns = list(dict.fromkeys(column for row in rows for column in row))  # solvers have more of them
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return
    measures = _other_measures(results)
    lines = [
        [" ".join(cell.splitlines()) for cell in (name, *_cells(results, row, measures))]
        for name, row in _best_first(results)
    ]
    kind = {"markdown": "github", "latex": "latex_booktabs"}[style]
    headings = ["scheduler", *_headings(results, measures)]
    file.write(tabulate(lines, headers=headings, tablefmt=kind, disable_numparse=True) + "\n")


def _best_first(results: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    higher = results["better"] != "lower"
    return sorted(results["schedulers"].items(), key=lambda item: item[1]["M1"]["mean"], reverse=higher)


def _flat_row(results: dict[str, Any], name: str, row: dict[str, Any]) -> dict[str, Any]:
    """A scheduler's numbers by the names of their columns; None where there is none."""
    flat: dict[str, Any] = {"scheduler": name}
    measures = ["M1", "difference", *(["M2"] if "reference" in results else []), *_other_measures(results)]
    for measure in measures:
        of = row.get(measure, {"mean": None})
        flat |= {f"{measure} {part}": of[part] for part in ("mean", "std", "iqm") if part in of}
        for interval in ("ci95_such_instances", "ci95_these_instances"):
            if interval in of:
                low, high = of[interval] or (None, None)
                flat |= {f"{measure} {interval} low": low, f"{measure} {interval} high": high}
    return flat


def _headings(results: dict[str, Any], measures: list[str]) -> list[str]:
    return ["M1", "IQM", "difference", *(["M2 %"] if "reference" in results else []), *measures]


def _cells(results: dict[str, Any], row: dict[str, Any], measures: list[str]) -> list[str]:
    """A scheduler's cells under `_headings`: a figure, and below it its spread or its intervals."""
    m1, difference = row["M1"], row["difference"]
    cells = [
        f"{_number(m1['mean'], 4)}\n{_spread(m1)}",
        f"{_number(m1['iqm'], 4)}\n{_intervals(m1)}",
        f"{_number(difference['mean'], 4, '+')}\n{_intervals(difference)}",
    ]
    if "reference" in results:
        cells.append(f"{row['M2']['mean']:.1f}\n{_spread(row['M2'], 1)}")
    return cells + [_cell(row.get(measure)) for measure in measures]


def _print_table(results: dict[str, Any], console: Console) -> None:
    measures = [name for name in _other_measures(results) if console.width >= _WIDE or name in _ALWAYS]
    table = Table(title=_title(results), caption=_caption(results), show_lines=False, box=box.SIMPLE_HEAD)
    table.add_column("scheduler", overflow="ellipsis", min_width=_SHORTEST_NAME)
    headings = _headings(results, measures)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    widths = [len(heading) for heading in headings]
    for name, row in _best_first(results):
        cells = _cells(results, row, measures)
        widths = [max(w, *map(len, cell.splitlines())) for w, cell in zip(widths, cells, strict=True)]
        table.add_row("\n".join([name, *_notes(results, row)]), *cells)
    # Two spaces beside every column, one between columns, one at each side: where that is too wide, lines are longer
    # than the terminal.
    needed = _SHORTEST_NAME + sum(widths) + 2 * (len(widths) + 1) + len(widths) + 2
    if console.width < needed:
        console = Console(file=console.file, width=needed)
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


def print_rows(
    headings: list[str], rows: list[list[str]], *, title: str = "", caption: str = "", stderr: bool = False
) -> None:
    """A table of texts: never a cell less than there is, however narrow the terminal; the caption below it."""
    console = Console(stderr=stderr)
    table = Table(title=title or None, box=box.SIMPLE_HEAD, title_justify="left")
    for heading in headings:
        table.add_column(heading, no_wrap=True)
    for row in rows:
        table.add_row(*map(escape, row))
    widths = [max(map(len, cells)) for cells in zip(headings, *rows, strict=True)]
    needed = sum(widths) + 3 * len(widths) + 2
    Console(file=console.file, width=max(console.width, needed)).print(table)
    if caption:
        console.print(caption, highlight=False, markup=False)


def print_bench(figures: dict[str, Any], *, stderr: bool = False) -> None:
    """The figures of `marl-sched bench`, each with what it is of, to standard output or standard error."""
    title = f"{figures['env']}: {figures['threads']} thread, {figures['statistic']} ({figures['repeats']})"
    table = Table("figure", "value", "of", title=title, box=box.SIMPLE_HEAD)
    for name, meaning in figures["meaning"].items():
        value = figures[name]
        parts = (
            {f"{name} {part}": number for part, number in value.items()} if isinstance(value, dict) else {name: value}
        )
        for label, number in parts.items():
            table.add_row(label, f"{number:,.2f}", meaning)
    Console(stderr=stderr).print(table)


def _other_measures(results: dict[str, Any]) -> list[str]:
    known = ("M1", "M2", "difference", results["objective"])
    found: dict[str, None] = {}
    for row in results["schedulers"].values():
        for name, value in row.items():
            if isinstance(value, dict) and name not in known and ("std" in value or name in _OF_SOLVERS):
                found[name] = None
    return list(found)


def _cell(value: dict[str, Any] | None) -> str:
    """Mean and standard deviation of a measure; empty where a scheduler does not have it."""
    if value is None or value["mean"] is None:
        return ""
    mean = _number(value["mean"], 4)
    return f"{mean}\n{_spread(value)}" if "std" in value else mean


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

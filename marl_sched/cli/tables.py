"""Results as tables on a terminal."""

from __future__ import annotations

import csv
import json
import sys
import textwrap
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from tabulate import tabulate

from marl_sched.errors import require
from marl_sched.problem import Problem, view_as_json
from marl_sched.statistics import PairedDifference, Summary
from marl_sched.train.evaluation.results import Gap, Measure, Results, SchedulerResults, view_in_short

if TYPE_CHECKING:
    from marl_sched.train.bench import Bench

_WIDE = 110  # columns of a terminal
_OF_SOLVERS = ("bound", "optimal", "timed_out", "without_plan")  # told by round, without a spread over instances
_NAME_WIDTH = 24  # columns for a scheduler's name and what is said of it
_SHORTEST_NAME = 12  # columns that a name keeps on a narrow terminal
FORMATS = ("table", "markdown", "latex", "csv", "json")
_LARGE = 10  # from here on a decimal is enough


def print_scores(results: Results, style: str = "table", *, stderr: bool = False) -> None:
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
        file.write(json.dumps(results.as_json(), indent=2, allow_nan=False) + "\n")
        return
    if style == "csv":
        rows = [_flat_row(results, name, row) for name, row in results.best_first]
        columns = list(dict.fromkeys(column for row in rows for column in row))  # solvers have more of them
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return
    measures = _other_measures(results)
    lines = [
        [" ".join(cell.splitlines()) for cell in (name, *_cells(results, row, measures))]
        for name, row in results.best_first
    ]
    kind = {"markdown": "github", "latex": "latex_booktabs"}[style]
    headings = ["scheduler", *_headings(results, measures)]
    file.write(tabulate(lines, headers=headings, tablefmt=kind, disable_numparse=True) + "\n")


def _flat_row(results: Results, name: str, row: SchedulerResults) -> dict[str, Any]:
    """A scheduler's numbers by the names of their columns; None where there is none."""
    flat: dict[str, Any] = {"scheduler": name}
    told: dict[str, Any] = {"M1": row.M1, "difference": row.difference}
    if results.reference is not None:
        told["M2"] = row.M2
    told |= {measure: row.figures.get(measure) for measure in _other_measures(results)}
    for measure, figure in told.items():
        of = figure.summary or figure if isinstance(figure, Measure) else figure
        flat |= {f"{measure} {part}": getattr(of, part) for part in ("mean", "std", "iqm") if hasattr(of, part)}
        if of is None:
            flat[f"{measure} mean"] = None
        for interval in ("ci95_such_instances", "ci95_these_instances"):
            if hasattr(of, interval):
                low, high = getattr(of, interval) or (None, None)
                flat |= {f"{measure} {interval} low": low, f"{measure} {interval} high": high}
    return flat


def _headings(results: Results, measures: list[str]) -> list[str]:
    first = results.problem.domain.headline
    gain = ["M2 %"] if results.reference is not None else []
    return [*first, "M1", "IQM", "difference", *gain, *(name for name in measures if name not in first)]


def _cells(results: Results, row: SchedulerResults, measures: list[str]) -> list[str]:
    """A scheduler's cells under `_headings`: a figure, and below it its spread or its intervals."""
    first = results.problem.domain.headline
    m1, difference = row.M1, row.difference
    cells = [
        f"{_number(m1.mean, 4)}\n{_spread(m1.std)}",
        f"{_number(m1.iqm, 4)}\n{_intervals(m1)}",
        f"{_number(difference.mean, 4, '+')}\n{_intervals(difference)}",
    ]
    if row.M2 is not None:
        cells.append(f"{row.M2.mean:.1f}\n{_spread(row.M2.std, 1)}")
    before = [_cell(row.figures.get(measure)) for measure in first]
    return [*before, *cells, *(_cell(row.figures.get(measure)) for measure in measures if measure not in first)]


def _print_table(results: Results, console: Console) -> None:
    measures = [name for name in _other_measures(results) if console.width >= _WIDE]
    table = Table(title=_title(results.problem), caption=_caption(results), show_lines=False, box=box.SIMPLE_HEAD)
    table.add_column("scheduler", overflow="ellipsis", min_width=_SHORTEST_NAME)
    headings = _headings(results, measures)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    widths = [len(heading) for heading in headings]
    for name, row in results.best_first:
        cells = _cells(results, row, measures)
        widths = [max(w, *map(len, cell.splitlines())) for w, cell in zip(widths, cells, strict=True)]
        table.add_row("\n".join([name, *_notes(results, row)]), *cells)
    # Two spaces beside every column, one between columns, one at each side: where that is too wide, lines are longer
    # than the terminal.
    needed = _SHORTEST_NAME + sum(widths) + 2 * (len(widths) + 1) + len(widths) + 2
    if console.width < needed:
        console = Console(file=console.file, width=needed)
    console.print(table)


def _notes(results: Results, row: SchedulerResults) -> list[str]:
    """What stands below a scheduler's name: what it knows besides, whether a local view showed too much for one."""
    notes = [f"({row.privileged_info})"] if row.privileged_info else []
    if results.problem.view.hides and not row.local:
        notes.append(f"(sees {100 * row.visible_share:.0f} %: not local)")
    return [line for note in notes for line in textwrap.wrap(note, _NAME_WIDTH)]


def _title(problem: Problem) -> str:
    scale = problem.pad or "given"
    words = problem.domain.in_words(problem.objective, problem.length)
    return f"{problem.domain.name}, {scale} instances: M1 is {words}"


def _caption(results: Results) -> str:
    problem, baseline = results.problem, results.baseline
    too_much = "" if results.local or not problem.view.hides else ", too much to be local"
    return (
        f"{problem.count} instances x {problem.episodes} episodes, seed {problem.seed}; "
        f"view {view_in_short(view_as_json(problem.view))}, "
        f"{100 * results.visible_share:.0f} % of the graph seen{too_much}. "
        f"difference: paired, to {baseline.scheduler} with the {baseline.view['kind']} view. "
        "±: over instances; 95 percent intervals: [ ] over such instances, ( ) over other noise on these instances"
    )


def print_rows(
    headings: list[str], rows: list[list[str]], *, title: str = "", caption: str = "", stderr: bool = False
) -> None:
    """A table of texts: never a cell less than there is, however narrow the terminal; the caption below it."""
    console = Console(stderr=stderr)
    table = Table(title=title or None, box=box.SIMPLE_HEAD, title_justify="left")
    for heading in headings:
        table.add_column(escape(heading), no_wrap=True)
    for row in rows:
        table.add_row(*map(escape, row))
    widths = [max(map(len, cells)) for cells in zip(headings, *rows, strict=True)]
    needed = sum(widths) + 3 * len(widths) + 2
    Console(file=console.file, width=max(console.width, needed)).print(table)
    if caption:
        console.print(caption, highlight=False, markup=False)


def print_bench(now: Bench, earlier: Bench | None = None, *, stderr: bool = False) -> None:
    """The figures of `marl-sched bench`, each with what it is of, to standard output or standard error.

    Beside earlier ones: what they were, and how much slower each has become.
    """
    from marl_sched.train.bench import SLOWER

    title = f"{now.env}: {now.threads} thread, {now.statistic} ({now.repeats}); calibration {now.calibration_ms:.2f} ms"
    console = Console(stderr=stderr)
    if earlier is None:
        table = Table("figure", "value", "of", title=title, box=box.SIMPLE_HEAD)
        for name, figure in now.figures.items():
            table.add_row(name, f"{figure.value:,.2f}", figure.meaning)
        console.print(table)
        return
    caption = f"slower: in units of a calibration that took {earlier.calibration_ms:.2f} ms then"
    table = Table("figure", "then", "now", "slower", "", title=title, caption=caption, box=box.SIMPLE_HEAD)
    ratios = now.against(earlier)
    for name, figure in now.figures.items():
        then = f"{earlier.figures[name].value:,.2f}" if name in ratios else "not measured"
        ratio = f"x {ratios[name]:.2f}" if name in ratios else ""
        table.add_row(name, then, f"{figure.value:,.2f}", ratio, "SLOWER" if ratios.get(name, 0) > SLOWER else "")
    for name in earlier.figures.keys() - now.figures.keys():
        table.add_row(name, f"{earlier.figures[name].value:,.2f}", "not measured", "", "")
    console.print(table)


def _other_measures(results: Results) -> list[str]:
    """What is told beside M1, M2 and the difference: what has a spread, and what solvers count."""
    found: dict[str, None] = {}
    for row in results.schedulers.values():
        for name, figure in row.figures.items():
            spread = isinstance(figure, Gap) or figure.summary is not None
            if name != results.problem.objective and (spread or name in _OF_SOLVERS):
                found[name] = None
    return list(found)


def _cell(figure: Measure | Gap | None) -> str:
    """Mean and standard deviation of a measure; empty where a scheduler does not have it."""
    if figure is None or figure.mean is None:
        return ""
    mean = _number(figure.mean, 4)
    if isinstance(figure, Measure):
        return mean if figure.summary is None else f"{mean}\n{_spread(figure.summary.std)}"
    return f"{mean}\n{_spread(figure.std)}"


def _intervals(of: Summary | PairedDifference) -> str:
    """The interval over such instances in brackets, over the noise of these instances in parentheses."""
    such, these = of.ci95_such_instances, of.ci95_these_instances
    lines = [f"[{_number(such[0], 3)}, {_number(such[1], 3)}]"] if such else []
    lines += [f"({_number(these[0], 3)}, {_number(these[1], 3)})"] if these else []
    return "\n".join(lines)


def _spread(std: float | None, decimals: int = 3) -> str:
    return "one instance" if std is None else f"± {_number(std, decimals)}"


def _number(value: float, decimals: int, sign: str = "") -> str:
    """A score with its decimals: shares need them, makespans do not."""
    return f"{value:{sign}.{1 if abs(value) >= _LARGE else decimals}f}"

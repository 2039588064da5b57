"""The page of a domain's comparisons as Markdown, drawn from cells alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marl_sched.errors import MarlSchedError
from marl_sched.statistics import paired_difference
from marl_sched.train.published.by_round import by_round
from marl_sched.train.published.comparisons import Cell, Comparison, Comparisons, Entry, Place, places

_NONE = "-"


@dataclass(frozen=True)
class _Scale:
    """One scale of a table: the cells of its rows by label, and the domain's words."""

    table: Comparison
    scale: str
    cells: Mapping[str, Cell]
    objective: str

    def first(self, label: str, count: int) -> Cell | None:
        """A row's cell if it has at least so many instances."""
        cell = self.cells.get(label)
        return cell if cell is not None and len(cell.objective) >= count else None


def page(plan: Comparisons, cells: Mapping[str, Cell], command: str, *, quick: bool = False) -> str:
    """The whole page. Raises MarlSchedError for a cell that is not there, with the command that makes it."""
    wanted = places(plan, quick=quick)
    lacking = [place for place in wanted if place.inputs.name not in cells]
    if lacking:
        first = lacking[0]
        raise MarlSchedError(
            f"{len(lacking)} cells are missing, {first.entry.label} on {first.scale} of {first.comparison.title!r} "
            f"among them: `{command}` makes them"
        )
    parts = [*_head(plan, command, quick=quick)]
    for table in plan.comparisons:
        parts += [f"## {table.title}", *([table.text.strip()] if table.text else [])]
        for scale in table.instances:
            of_scale = [place for place in wanted if place.comparison is table and place.scale == scale]
            made = {place.entry.label: cells[place.inputs.name] for place in of_scale}
            parts.append(_scale_table(_Scale(table, scale, made, plan.objective)))
            if table.horizon > 1 and made:
                parts += [f"By round, feasible and {plan.objective}:", _markdown(*by_round(made))]
        parts += _remarks(table)
    parts += [*_trained(wanted, cells), _revisions(wanted, cells)]
    return "\n\n".join(parts) + "\n"


def _head(plan: Comparisons, command: str, *, quick: bool) -> Iterator[str]:
    yield f"# {plan.env}: schedulers side by side"
    if quick:
        yield "**Quick look:** few instances. Figures to keep are made without `--quick`."
    yield (
        f"Made by `{command}`: seed {plan.seed}, the same instances and noise for all rows of a table. This page is "
        "rendered from the cells beside it and says nothing that they do not."
    )
    yield (
        f"**Feasible** is the share of rounds, **{plan.objective}** the mean over rounds, an infeasible one being "
        "charged the domain's worst case. *In italics*, behind: what the dissertation published "
        f"({plan.source}), on other instances of the same distribution. **Over** is the mean ratio to the row that "
        "stands for the optimum, over rounds feasible for both. **Within r** is the percentage of rounds solved with "
        "at most r times that row's objective, any solution counting where that row has none. **Difference** is in "
        f"{plan.objective}, in percent of the baseline's mean, paired by instance, with the 95 percent interval for "
        "such instances; a row of fewer instances is held against the same ones of the baseline. **CPU** is processor "
        "time for a round, simulation included, many instances in one batch where the scheduler can."
    )
    if plan.note:
        yield plan.note.strip()


def _scale_table(of: _Scale) -> str:
    table = of.table
    heads = ["scheduler", "feasible %", of.objective, f"difference to {table.baseline} %", "CPU ms"]
    if table.exact is not None:
        heads.insert(3, f"over {table.exact}")
    heads[4:4] = [f"within {ratio:g}" for ratio in table.within]
    if table.view["kind"] != "full":
        heads.append("sees %")
    lines = [_line(of, row, heads) for row in table.rows if row.label in of.cells or of.scale in row.published]
    rounds = "" if table.horizon == 1 else f" x {table.horizon} rounds"
    return f"### {of.scale}: {table.instances[of.scale]} instances{rounds}\n\n{_markdown(heads, lines)}"


def _line(of: _Scale, row: Entry, heads: Sequence[str]) -> list[str]:
    """A row's figures on a scale."""
    cell, published = of.cells.get(row.label), row.published.get(of.scale)
    told = [""] * 2 if published is None else [_published(published.feasible), _published(published.objective)]
    if cell is None:
        return [row.label, *(one or _NONE for one in told), *[_NONE] * (len(heads) - 3)]
    fewer = "" if len(cell.objective) == _most(of) else f" ({len(cell.objective)} instances)"
    figures = [
        f"{row.label}{fewer}",
        f"{100 * np.mean(np.concatenate(cell.feasible)):.1f} {told[0]}".strip(),
        f"{np.mean(np.concatenate(cell.objective)):.1f} {told[1]}".strip(),
    ]
    if of.table.exact is not None:
        exact = of.first(of.table.exact, 1)
        figures.append(_ratio(cell, exact))
        figures += [_NONE if exact is None else f"{100 * solved_within(cell, exact, r):.0f}" for r in of.table.within]
    figures.append(_difference(cell, of.first(of.table.baseline, len(cell.objective))))
    rounds = sum(len(one) for one in cell.objective)
    figures.append(f"{1000 * cell.cpu_seconds / rounds:.3g}")
    if of.table.view["kind"] != "full":
        figures.append(f"{100 * cell.visible_share:.0f}")
    return figures


def _most(of: _Scale) -> int:
    return max(len(cell.objective) for cell in of.cells.values())


def _ratio(cell: Cell, exact: Cell | None) -> str:
    """The mean ratio of the objective over rounds that are feasible for both."""
    if exact is None:
        return _NONE
    ratios = [
        ours / theirs
        for i in range(min(len(cell.objective), len(exact.objective)))
        for ours, theirs, *good in zip(
            cell.objective[i], exact.objective[i], cell.feasible[i], exact.feasible[i], strict=True
        )
        if all(good)
    ]
    return f"{np.mean(ratios):.3f}" if ratios else _NONE


def solved_within(cell: Cell, exact: Cell, ratio: float) -> float:
    """The share of rounds that are feasible with an objective of at most `ratio` times the exact one's (section 4.4.3).

    Of the instances that both have played. Where the exact row found nothing, any feasible round counts.
    """
    solved = [
        bool(good) and (not known or ours <= ratio * theirs)
        for i in range(min(len(cell.objective), len(exact.objective)))
        for ours, theirs, good, known in zip(
            cell.objective[i], exact.objective[i], cell.feasible[i], exact.feasible[i], strict=True
        )
    ]
    return float(np.mean(solved))


def _published(value: float | None) -> str:
    return "" if value is None else f"*{value:g}*"


def _difference(cell: Cell, baseline: Cell | None) -> str:
    if baseline is None or baseline is cell:
        return _NONE
    count = len(cell.objective)
    ours, theirs = (np.array([[np.mean(rounds)] for rounds in one.objective[:count]]) for one in (cell, baseline))
    found, scale = paired_difference(ours, theirs), 100.0 / theirs.mean()
    low, high = found.ci95_such_instances or (np.nan, np.nan)
    return f"{scale * found.mean:+.1f} [{scale * low:+.1f}, {scale * high:+.1f}]"


def _remarks(table: Comparison) -> list[str]:
    told = [f"- {row.label}: {row.remark.strip()}" for row in table.rows if row.remark]
    return ["\n".join(told)] if told else []


def _trained(wanted: Sequence[Place], cells: Mapping[str, Cell]) -> Iterator[str]:
    """How the learned schedulers were trained, by their cards."""
    cards = {}
    for place in wanted:
        cell = cells[place.inputs.name]
        if cell.command:
            used = f" Training used {cell.knowledge}." if cell.knowledge else ""
            cards[cell.inputs.scheduler] = f"- `{cell.inputs.scheduler}`: `{cell.command}`.{used}"
    if cards:
        yield "## How the learned schedulers were trained"
        yield "\n".join(cards.values())


def _revisions(wanted: Sequence[Place], cells: Mapping[str, Cell]) -> str:
    made = [cells[name].revision for name in dict.fromkeys(place.inputs.name for place in wanted)]
    counts = {revision: made.count(revision) for revision in dict.fromkeys(made)}
    told = ", ".join(f"`{name[:12] or 'unknown'}` ({count})" for name, count in counts.items())
    return f"The cells were made at these revisions of the source, how many at each in brackets: {told}."


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] + ["---:"] * (len(heads) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)

"""The page of the tables as Markdown, drawn from the figures of `results` alone.

What it says of ranks, margins and ways is worked out from the figures; nothing is claimed in advance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from marl_sched.files import replacing, write_json
from marl_sched.privileged import PrivilegedInfo
from marl_sched.train.evaluation.plots import save
from marl_sched.train.evaluation.results import LOCAL_SHARE
from marl_sched.train.published.entries import Entries
from marl_sched.train.published.picture import price_of_decentralisation
from marl_sched.train.published.remarks import reading_aid
from marl_sched.train.published.results import Results
from marl_sched.train.published.store import Cells

PICTURE = "price-of-decentralisation.png"
_NONE = "-"
_MODES = {
    "greedy": "greedily",
    "sample": "by sampling",
    "one_pass": "by sampling for all who decide at a decision epoch from one forward pass",
}


def page(results: Mapping[str, Any]) -> str:
    """The whole page."""
    parts = [*_head(results)]
    for objective, table in results["objectives"].items():
        parts += [f"## {objective.capitalize()}", _published_layout(table), reading_aid(table)]
        parts.append(_against_limits(table, results["episodes"]))
    parts += [*_decentralisation(results), *_learned(results), *_untrained(results), *_made_by(results)]
    return "\n\n".join(parts) + "\n"


def _head(results: Mapping[str, Any]) -> Iterator[str]:
    yield f"# {results['env']}: the published tables, made again"
    if results["quick"]:
        yield "**Quick look:** few instances and episodes, a loose bound. Figures to keep are made without `--quick`."
    bound, hidden = results["bound"], PrivilegedInfo.of(results["hidden_info"])
    fewer = "; rows that say that they played fewer episodes are held against means over all, with wider intervals"
    yield (
        f"Made by `{results['command']}`: {results['instances']} instances of each scale x {results['episodes']} "
        f"episodes of {results['horizon']} {results['unit']}, seed {results['seed']}, "
        "common random numbers for all. This page is rendered from the cells beside it and says nothing that they do "
        "not."
    )
    yield (
        f"**M1** is {results['measure']}, **M2** the gain "
        f"in percent over {results['reference']} on the same instance; ± is the standard deviation over instances of "
        f"their means. *In italics*, below: what the dissertation published ({results['source']}), on other "
        f"instances of the same distribution. **Difference** is paired, to the best rule on that scale"
        f"{f' that does not know the {hidden}' if hidden else ''}{fewer if _some_fewer(results) else ''}. "
        "**IQM** is the interquartile mean of the instances. Intervals hold 95 percent for such instances: other ones "
        "drawn from the same distribution. **Way** is how much of the "
        f"distance from {results['reference']} to the upper bound a scheduler goes. The bound is proved for every "
        f"instance by `marl-sched bound` ({bound['price_vectors']} price vectors, {bound['evaluations']} evaluations): "
        f"no scheduler expects more{_even(PrivilegedInfo.of(results['bound_info']))}; a mean over few episodes can "
        "pass it by chance."
    )
    if results["note"]:
        yield results["note"]


def _even(known: PrivilegedInfo) -> str:
    """What the bound allows to be known, in words."""
    return f", even if it knows {' and '.join(f'the {part}' for part in known)}" if known else ""


def _published_layout(table: Mapping[str, Any]) -> str:
    """The table as the dissertation prints it: M1 and M2 on every scale."""
    scales = list(table["scales"])
    heads = ["scheduler", *(f"{scale} {measure}" for scale in scales for measure in ("M1", "M2 %"))]
    rows = []
    for row in table["rows"]:
        line = [_name(row)]
        for scale in scales:
            figures = row["scales"].get(scale, {})
            line += [_beside(figures, "M1"), _beside(figures, "M2")]
        rows.append(line)
    bounds = [f"{table['scales'][scale]['bound']['M1']['mean']:.4f}" for scale in scales]
    rows.append(["**upper bound**", *(cell for bound in bounds for cell in (f"**{bound}**", ""))])
    return _markdown(heads, rows)


def _beside(figures: Mapping[str, Any], measure: str) -> str:
    """A measure as it was found here and, below, as it was published."""
    lines = []
    if measure in figures:
        lines.append(_spread(measure, figures[measure]["mean"], figures[measure]["std"]))
    elif "untrained" in figures and measure == "M1":
        lines.append("not trained yet")
    if (published := figures.get("published")) is not None:
        key = measure.lower()
        lines.append(f"*{_spread(measure, published[key], published[key + '_std'])}*")
    return "<br>".join(lines) or _NONE


def _against_limits(table: Mapping[str, Any], episodes: int) -> str:
    """What every row knows, and what it reaches of what can be reached; `episodes` of those who played all."""
    scales = list(table["scales"])
    heads = ["scheduler", "sees", "knows besides"]
    heads += [f"{scale}: IQM, difference to {table['scales'][scale]['best_rule']}" for scale in scales]
    heads += [f"gap closed % {'/'.join(scales)}"]
    rows = []
    for row in table["rows"]:
        entries = [row["scales"].get(scale, {}) for scale in scales]
        played = [entry for entry in entries if "M1" in entry]
        if not played:
            continue
        rows.append(
            [
                _name(row) + _played_by(row, played) + _fewer(row, episodes),
                _sees(row, played),
                str(PrivilegedInfo.of(played[0]["privileged_info"])) or "nothing",
                *(_against(entry) for entry in entries),
                " / ".join(f"{entry['gap_closed']:.1f}" if "gap_closed" in entry else _NONE for entry in entries),
            ]
        )
    return _markdown(heads, rows)


def _against(entry: Mapping[str, Any]) -> str:
    """Interquartile mean and paired difference, each with its interval."""
    if "M1" not in entry:
        return _NONE
    low, high = entry["M1"]["ci95_such_instances"]
    return f"{entry['M1']['iqm']:.4f} [{low:.4f}, {high:.4f}]<br>{_difference(entry['difference'])}"


def _played_by(row: Mapping[str, Any], played: Sequence[Mapping[str, Any]]) -> str:
    """The names of the schedulers below the row's own, where they are others."""
    names = dict.fromkeys(entry["scheduler"].rpartition("/")[2].removesuffix(".safetensors") for entry in played)
    return "".join(f"<br>`{name}`" for name in names if name != row["label"])


def _some_fewer(results: Mapping[str, Any]) -> bool:
    """Whether any row of the tables has played fewer episodes than the others."""
    rows = [row for table in results["objectives"].values() for row in table["rows"]]
    return any(_fewer(row, results["episodes"]) for row in rows)


def _fewer(row: Mapping[str, Any], episodes: int) -> str:
    """On which scales a row has played fewer episodes than the others."""
    found = [
        f"{entry['episodes']} on {scale}"
        for scale, entry in row["scales"].items()
        if "M1" in entry and entry["episodes"] < episodes
    ]
    return f"<br>episodes: {', '.join(found)}" if found else ""


def _sees(row: Mapping[str, Any], played: Sequence[Mapping[str, Any]]) -> str:
    """The view in words and the share of the graph that it showed on every scale."""
    options = {name: value for name, value in row["view"].items() if name != "kind"}
    if not options:
        return "everything"
    shares = [entry["visible_share"] for entry in played]
    told = " / ".join(f"{100 * share:.0f}" for share in shares)
    local = "" if max(shares) <= LOCAL_SHARE else "; too much to be called local"
    return f"{_view(row['view'])}: {told} %{local}"


def _decentralisation(results: Mapping[str, Any]) -> Iterator[str]:
    section, agent = results["decentralisation"], results["agent"]
    hidden = PrivilegedInfo.of(results["hidden_info"])
    yield "## The price of deciding alone"
    yield f"![M1 against the share of the graph that a {agent} sees]({PICTURE})"
    yield (
        f"M1 ({section['objective']}, {section['episodes']} episodes of each instance) of the same schedulers under "
        f"views that show less and less. A view is (how far a {agent} sees, how far it hears, how old its snapshot of "
        "others' sectors is). Below each score is what the view costs that scheduler: the paired difference to itself, "
        "or to its sibling, under the full view, with its 95 percent interval."
    )
    for scale, found in section["scales"].items():
        lines = found["lines"]
        rows = []
        for name, view in section["views"].items():
            points = [line["points"].get(name) for line in lines]
            shares = [point["visible_share"] for point in points if point is not None]
            share = f"{100 * sum(shares) / len(shares):.0f} %" if shares else _NONE
            rows.append([f"{name}<br>{_view(view)}", share, *(_point(line, name) for line in lines)])
        yield f"### On {scale} instances"
        yield _markdown(["view", "sees", *(line["label"] for line in lines)], rows)
        yield (
            f"Upper bound {found['bound']:.4f}; the best that sees everything"
            f"{f' and does not know the {hidden}' if hidden else ''}: "
            f"{found['central']['label']}, {found['central']['M1']:.4f}."
        )


def _point(line: Mapping[str, Any], view: str) -> str:
    """A line's score under a view and what that view costs it."""
    if (point := line["points"].get(view)) is None:
        return "not trained yet" if view in line["untrained"] else _NONE
    score = f"{point['M1']['mean']:.4f} ± {point['M1']['std']:.3f}"
    cost = point.get("cost")
    return score if cost is None or cost["mean"] == 0.0 else f"{score}<br>{_difference(cost)}"


def _learned(results: Mapping[str, Any]) -> Iterator[str]:
    """How every learned scheduler was trained, by its card."""
    cards: dict[str, str] = {}
    rows = [row for table in results["objectives"].values() for row in table["rows"]]
    entries = [(row["label"], entry) for row in rows for entry in row["scales"].values()]
    for found in results["decentralisation"]["scales"].values():
        entries += [(line["label"], point) for line in found["lines"] for point in line["points"].values()]
    for label, entry in entries:
        if (training := entry.get("training")) is not None:
            mode = _MODES[entry["mode"]]
            knowledge = f" Training used {training['knowledge']}." if training["knowledge"] else ""
            told = f"seed {training['seed']}, view {_view(training['view'])}, plays {mode}.{knowledge}"
            cards.setdefault(entry["scheduler"], f"- `{entry['scheduler']}` ({label}): `{training['command']}`, {told}")
    if cards:
        yield "## How the learned schedulers were trained"
        yield "\n".join(cards.values())
    remarks = {row["label"]: row["remark"] for row in rows if row["remark"]}
    if remarks:
        yield "## Remarks"
        yield "\n".join(f"- {label}: {remark}" for label, remark in remarks.items())


def _untrained(results: Mapping[str, Any]) -> Iterator[str]:
    if results["untrained"]:
        yield "## Not trained yet"
        told = [
            f"- `{entry['policy']}` ({entry['label']})" + (f": `{entry['command']}`" if entry["command"] else "")
            for entry in results["untrained"]
        ]
        yield "\n".join(told)


def _name(row: Mapping[str, Any]) -> str:
    options = ", ".join(f"{name} {value}" for name, value in row["options"].items())
    name = f"{row['label']}<br>({options})" if options else row["label"]
    return name if row["group"] == "published" else f"`{name}`" if not options else name


def _view(view: Mapping[str, Any]) -> str:
    options = [str(value) for name, value in view.items() if name != "kind"]
    return f"{view['kind']} ({', '.join(options)})" if options else str(view["kind"])


def _spread(measure: str, mean: float, std: float) -> str:
    """Mean and deviation with the digits of the dissertation: three decimals for M1, three figures for percent."""
    return " ± ".join(f"{x:.{3 if measure == 'M1' else 1 if abs(x) >= 10 else 2}f}" for x in (mean, std))


def _difference(difference: Mapping[str, Any]) -> str:
    told = f"{difference['mean']:+.4f}"
    if difference["ci95_such_instances"] is None:
        return told
    low, high = difference["ci95_such_instances"]
    return f"{told} [{low:+.4f}, {high:+.4f}]"


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] + ["---:"] * (len(heads) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _made_by(results: Mapping[str, Any]) -> Iterator[str]:
    """Which revisions of the source made the cells."""
    told = ", ".join(f"`{name[:12] or 'unknown'}` ({count})" for name, count in results["revisions"].items())
    yield (
        f"The cells were made at these revisions of the source, how many at each in brackets: {told}. A sample of them "
        "is played again before cells of other kernels are added."
    )


def write_pages(entries: Entries, cells: Cells, command: str, folder: Path) -> list[Path]:
    """Work out the figures from cells and write them, the page and the picture into `folder`; their paths.

    Raises MarlSchedError, and writes nothing, if a cell is missing.
    """
    results = Results(entries, cells, command).as_json()
    data, text = folder / f"{entries.plan.env}.json", folder / f"{entries.plan.env}.md"
    write_json(data, results)
    with replacing(text) as temporary:
        temporary.write_text(page(results), encoding="utf-8")
    return [data, text, save(price_of_decentralisation(results), folder / PICTURE)]

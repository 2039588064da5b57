"""A few sentences below each table, worked out from its figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marl_sched.privileged import PrivilegedInfo


def reading_aid(table: Mapping[str, Any]) -> str:
    """What an objective's table shows: the best rows, learned ones against rules, published ranks that do not hold."""
    return " ".join([_best(table), _learned(table), *_above_the_bound(table), _ranks(table)])


def _best(table: Mapping[str, Any]) -> str:
    """Who has the best mean on each scale without what is hidden in the field."""
    hidden = PrivilegedInfo.of(table["hidden_info"])
    best, word = (min, "Lowest") if table["better"] == "lower" else (max, "Highest")
    told = []
    for scale in table["scales"]:
        entries = [(row, row["scales"][scale]) for row in table["rows"] if "M1" in row["scales"].get(scale, {})]
        blind = [pair for pair in entries if not PrivilegedInfo.of(pair[1]["privileged_info"]) & hidden]
        row, entry = best(blind, key=lambda pair: float(pair[1]["M1"]["mean"]))
        told.append(
            f"{row['label']} on {scale} ({entry['M1']['mean']:.4f}, {entry['gap_closed']:.1f} % of the gap closed)"
        )
    return f"{word} mean{f' without the {hidden}' if hidden else ''}: {_listed(told)}."


def _learned(table: Mapping[str, Any]) -> str:
    """Which learned rows pass the best rule by more than chance on all scales that they play."""
    learned = {
        row["label"]: [entry["difference"] for entry in row["scales"].values() if "M1" in entry]
        for row in table["rows"]
        if row["learned"]
    }
    sign = -1 if table["better"] == "lower" else 1
    learned = {label: differences for label, differences in learned.items() if differences}
    if not learned:
        return "No learned scheduler has played yet."
    above = [
        label
        for label, differences in learned.items()
        if all(min(sign * end for end in each["ci95_such_instances"] or [0.0]) > 0 for each in differences)
    ]
    if not above:
        return "No learned scheduler passes the best rule with an interval above zero on every scale that it plays."
    return f"Learned and above the best rule, with an interval above zero on every scale played: {_listed(above)}."


def _above_the_bound(table: Mapping[str, Any]) -> list[str]:
    """Means that pass the bound, which holds for expectations."""
    lower = table["better"] == "lower"
    above = [
        f"{row['label']} on {scale} ({entry['M1']['mean']:.4f})"
        for row in table["rows"]
        for scale, entry in row["scales"].items()
        if "M1" in entry and _passes(entry["M1"]["mean"], table["scales"][scale]["bound"]["M1"]["mean"], lower)
    ]
    return (
        [f"Means {'below' if lower else 'above'} the bound, which binds expectations: {_listed(above)}."]
        if above
        else []
    )


def _passes(mean: float, bound: float, lower: bool) -> bool:
    return mean < bound if lower else mean > bound


def _ranks(table: Mapping[str, Any]) -> str:
    found = [f"{c['lower']} is below {c['higher']} on {_listed(list(c['scales']))}" for c in table["contradictions"]]
    if not found:
        return "No two methods of the dissertation stand in another order here by more than chance explains."
    return (
        "Of the dissertation's methods some stand here in another order than published, beyond chance at 5 percent "
        f"over all pairs of a scale (Holm's correction): {'; '.join(found)}."
    )


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"

"""The figures of the tables, worked out from cells: plain data, which the page and the picture are drawn from.

All statistics are over instances, whose scores are means over episodes. M2 is the gain over the domain's reference
scheduler on the same instance. Differences are paired, to the best rule of the same table and scale that does not
know what is hidden in the field (`Domain.hidden_info`). The gap closed is the share of the distance from the
reference to the bound, in percent.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations
from typing import Any

import msgspec
import numpy as np

from marl_sched.errors import MarlSchedError
from marl_sched.privileged import PrivilegedInfo
from marl_sched.statistics import CONFIDENCE, holm, paired_difference, percent_gain, summarise
from marl_sched.train.published.cells import Cell, Job, describe, digest
from marl_sched.train.published.entries import Entries, Untrained
from marl_sched.train.published.plan import Line, Row
from marl_sched.train.published.store import Cells

SCHEMA = 4  # 1 named the horizon by its unit, 2 had no revisions, 3 told what schedulers know in words


class Results:
    """Works out the figures of a plan's entries from the cells of a folder.

    Raises MarlSchedError for a cell that is not there, with `command`, which makes it.
    """

    def __init__(self, entries: Entries, cells: Cells, command: str) -> None:
        self._entries, self._plan, self._cells, self._command = entries, entries.plan, cells, command

    def as_json(self) -> dict[str, Any]:
        """Everything that the page says, all numbers rounded to six decimals."""
        plan, size = self._plan, self._entries.size
        tables = {objective: self._table(objective) for objective in plan.objectives}
        data = {
            "schema": SCHEMA,
            "env": plan.env,
            "command": self._command,
            "quick": size == plan.quick,
            "instances": size.instances,
            "episodes": size.episodes,
            "horizon": self._entries.horizon,
            "unit": plan.domain.unit,
            "seed": plan.seed,
            "bound": msgspec.to_builtins(size.bound),
            "measure": plan.measure,
            "source": plan.source,
            "note": plan.note.strip(),
            "reference": self._reference_row().label,
            "agent": plan.domain.agent_prefix,
            "hidden_info": plan.domain.hidden_info.names,
            "bound_info": plan.domain.bound_info.names,
            "objectives": tables,
            "decentralisation": self._decentralisation(),
            "revisions": self._cells.revisions(),
            "untrained": [vars(entry) for entry in self._entries.all()[1]],
        }
        return _rounded(data)

    def _table(self, objective: str) -> dict[str, Any]:
        """The rows of an objective's table, and what every scale's entries are held against."""
        scales = {scale: self._scale(objective, scale) for scale in self._plan.scales}
        rows = [self._row(row, objective, scales) for row in self._plan.rows if self._stands_in(row, objective)]
        return {
            "better": self._plan.domain.better,
            "hidden_info": self._hidden.names,
            "scales": {
                scale: {"bound": found["bound"], "best_rule": found["best_rule"]} for scale, found in scales.items()
            },
            "rows": rows,
            "contradictions": self._contradictions(objective),
        }

    def _contradictions(self, objective: str) -> list[dict[str, Any]]:
        """Pairs of methods that stand in another order than published, beyond chance at 5 percent.

        So many pairs are looked at that the p-values of a scale are corrected for it (marl_sched.statistics.holm).
        """
        found: dict[tuple[str, str], dict[str, Any]] = {}
        for scale in self._plan.scales:
            methods = [
                (row.label, row.published[objective][scale].m1, _scores(cell))
                for row in self._plan.rows
                if scale in row.published.get(objective, {})
                and (cell := self._cell(self._entries.row(row, objective, scale))) is not None
            ]
            sign = -1 if self._lower else 1
            pairs = {
                (one, other): paired_difference(scores, more)
                for (one, published, scores), (other, less, more) in permutations(methods, 2)
                if sign * published > sign * less
            }
            corrected = holm([1.0 if difference.p is None else difference.p for difference in pairs.values()])
            for (pair, difference), p in zip(pairs.items(), corrected, strict=True):
                if sign * difference.mean < 0 and p < 1 - CONFIDENCE:
                    found.setdefault(pair, {})[scale] = difference.as_json()
        return [{"lower": one, "higher": other, "scales": scales} for (one, other), scales in found.items()]

    def _stands_in(self, row: Row, objective: str) -> bool:
        return any(row.plays(objective, scale) for scale in self._plan.scales)

    def _scale(self, objective: str, scale: str) -> dict[str, Any]:
        """Bound, reference and best rule of a scale."""
        played = {
            row.label: cell
            for row in self._plan.rows
            if isinstance(cell := self._cell(self._entries.row(row, objective, scale)), Cell)
        }
        rules = {
            label: cell for label, cell in played.items() if cell.training is None and not cell.knows & self._hidden
        }
        best = self._best({label: float(np.mean(cell.M1)) for label, cell in rules.items()})
        bound = self._made(self._entries.bound(objective, scale))
        return {
            "bound": {"M1": self._summary(bound), "seconds": bound.seconds, "cell": digest(bound.inputs)},
            "best_rule": best,
            "best": _scores(rules[best]),
            "reference": _scores(played[self._reference_row().label]),
        }

    def _row(self, row: Row, objective: str, scales: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = {
            "label": row.label,
            "group": row.group,
            "learned": row.rule is None,
            "view": row.view,
            "options": row.options,
            "remark": row.remark,
            "scales": {},
        }
        for scale, against in scales.items():
            entry = self._entries.row(row, objective, scale)
            cell = self._cell(entry)
            figures: dict[str, Any] = {} if cell is None else self._figures(cell, against)
            if isinstance(entry, Untrained):
                figures["untrained"] = entry.policy
            if (published := row.published.get(objective, {}).get(scale)) is not None:
                figures["published"] = msgspec.structs.asdict(published)
            if figures:
                found["scales"][scale] = figures
        return found

    def _figures(self, cell: Cell, against: Mapping[str, Any]) -> dict[str, Any]:
        """One entry's figures, held against the reference, the best rule and the bound of its scale."""
        scores, reference = _scores(cell), against["reference"]
        gain = percent_gain(scores, reference)
        bound, base = against["bound"]["M1"]["mean"], float(reference.mean())
        return {
            "scheduler": getattr(cell.inputs, "scheduler", ""),
            "mode": getattr(cell.inputs, "mode", None),
            "episodes": getattr(cell.inputs, "episodes", None),
            "M1": self._summary(cell),
            "M2": {"mean": float(-gain.mean() if self._lower else gain.mean()), "std": float(gain.std())},
            "difference": paired_difference(scores, against["best"]).as_json(),
            "gap_closed": 100.0 * (float(scores.mean()) - base) / (bound - base),
            "visible_share": cell.visible_share,
            "privileged_info": cell.privileged_info,
            "training": None if cell.training is None else msgspec.to_builtins(cell.training),
            "seconds": cell.seconds,
            "cell": digest(cell.inputs),
        }

    def _decentralisation(self) -> dict[str, Any]:
        """The lines of every scale: points by view, with what the view costs the scheduler that has the full one."""
        section = self._plan.decentralisation
        scales = {}
        for scale in section.scales:
            against = self._scale(section.objective, scale)
            lines = [self._line(line, scale, against) for line in section.lines]
            full_views = [name for name, view in section.views.items() if _is_full(view)]
            seeing_all = [(line["label"], line["points"].get(name, {})) for line in lines for name in full_views]
            central = {
                label: float(figures["M1"]["mean"])
                for label, figures in seeing_all
                if "M1" in figures and not PrivilegedInfo.of(figures["privileged_info"]) & self._hidden
            }
            best = self._best(central)
            scales[scale] = {
                "bound": against["bound"]["M1"]["mean"],
                "central": {"label": best, "M1": central[best]},
                "lines": lines,
            }
        episodes = self._entries.size.episodes
        return {
            "objective": section.objective,
            "episodes": min(episodes, section.episodes or episodes),
            "views": section.views,
            "scales": scales,
        }

    def _line(self, line: Line, scale: str, against: Mapping[str, Any]) -> dict[str, Any]:
        views = self._plan.decentralisation.views
        entries = {name: self._entries.point(line, name, scale) for name in views}
        cells = {name: cell for name, entry in entries.items() if (cell := self._cell(entry)) is not None}
        full = next((cells[name] for name, view in views.items() if _is_full(view) and name in cells), None)
        points = {}
        for name, cell in cells.items():
            points[name] = self._figures(cell, against)
            if full is not None:
                points[name]["cost"] = paired_difference(_scores(cell), _scores(full)).as_json()
        untrained = {name: entry.policy for name, entry in entries.items() if isinstance(entry, Untrained)}
        knows = next((f" ({cell.knows})" for cell in cells.values() if cell.knows), "")
        return {"label": line.label + knows, "points": points, "untrained": untrained}

    def _cell(self, entry: Job | Untrained | None) -> Cell | None:
        """The cell of an entry, None where there cannot be one; MarlSchedError where it is missing."""
        return self._made(entry) if isinstance(entry, Job) else None

    def _made(self, job: Job) -> Cell:
        cell = self._cells.read(job.inputs)
        if cell is None:
            raise MarlSchedError(
                f"{self._cells.path}: there is no cell for {describe(job.inputs)}; "
                f"make what is missing with `{self._command}`"
            )
        return cell

    @property
    def _hidden(self) -> PrivilegedInfo:
        return self._plan.domain.hidden_info

    @property
    def _lower(self) -> bool:
        """Whether a lower score is the better one."""
        return self._plan.domain.better == "lower"

    def _best(self, scores: Mapping[str, float]) -> str:
        """The name with the best score, the first of equals."""
        return (min if self._lower else max)(scores, key=lambda label: scores[label])

    def _reference_row(self) -> Row:
        reference = self._plan.domain.reference
        return next(row for row in self._plan.rows if row.rule == reference and _is_full(row.view))

    def _summary(self, cell: Cell) -> dict[str, Any]:
        return summarise(_scores(cell)).as_json()


def _is_full(view: Mapping[str, Any]) -> bool:
    return view["kind"] == "full"


def _scores(cell: Cell) -> np.ndarray:
    """Instance means as the statistics take them, float64 (I, 1): the interval is about the instances' population."""
    return np.array(cell.M1)[:, None]


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 6)
    if isinstance(value, Mapping):
        return {key: _rounded(inner) for key, inner in value.items()}
    return [_rounded(inner) for inner in value] if isinstance(value, list) else value

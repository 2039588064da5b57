"""Schedulers side by side in several settings of a domain, as cells from which one page is drawn.

`configs/published/<domain>.yaml` lists the tables (`Comparisons`). A cell is one scheduler on the instances of one
scale in one table's setting; it holds every round's objective and feasibility, so that all figures, paired ones too,
follow from cells. Cells are JSON lines, known by the hash of their inputs, the weights' SHA-256 among them:

    docs/results/<domain>/cells.jsonl
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from marl_sched.agents.policies.cards import source_revision
from marl_sched.agents.registry import create_scheduler, rules, shipped_policies
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError, require
from marl_sched.files import replacing
from marl_sched.problem import Problem, view_as_json
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from marl_sched.train.published.earlier import with_names
from marl_sched.train.published.plan import Count, Seed

SCHEMA = 1
QUICK = 10  # a quick look plays one of so many instances
_WARM_UP = 2  # instances that are played before time is taken


class _Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of the list; unknown keys are errors."""


class Published(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A published entry: share of feasible rounds in percent, and the objective where that was told."""

    feasible: float
    objective: float | None = None


class Entry(_Part, frozen=True, kw_only=True):
    """A row: a scheduler by its name in the setting of its table.

    Attributes:
        label: what stands in the table.
        scheduler: the name of a rule or of a shipped policy; None: nobody here plays what is published.
        settings: the scheduler's own options.
        scales: on which scales it plays; None: on all of the table.
        instances: scale -> number of instances, where they are fewer than the table's.
        published: scale -> the published entry.
        remark: printed below the table as it is.
    """

    label: str
    scheduler: str | None = None
    settings: dict[str, Any] = {}
    scales: list[str] | None = None
    instances: dict[str, Count] = {}
    published: dict[str, Published] = {}
    remark: str = ""


class Comparison(_Part, frozen=True, kw_only=True):
    """A table in one setting.

    Attributes:
        title, text: above it.
        options: of the simulator.
        view: as in `Domain.make_view`.
        horizon: length of an episode in the domain's unit.
        instances: scale -> number of instances.
        baseline: label of the row that the others are held against.
        exact: label of the row that stands for the optimum; None: none does.
        within: ratios to that row; the table has the share of all rounds that were solved within each.
        rows: in the order of the table.
    """

    title: str
    text: str = ""
    options: dict[str, Any] = {}
    view: dict[str, Any] = msgspec.field(default_factory=lambda: {"kind": "full"})
    horizon: Count
    instances: Annotated[dict[str, Count], Meta(min_length=1)]
    baseline: str
    exact: str | None = None
    within: list[Annotated[float, Meta(ge=1)]] = []
    rows: Annotated[list[Entry], Meta(min_length=1)]


class Comparisons(_Part, frozen=True, kw_only=True):
    """All tables of a domain.

    Attributes:
        env: the domain's name.
        objective: what is compared.
        seed: of instances and noise.
        source: where the published entries stand.
        note: below the page's first lines.
        comparisons: the tables.
    """

    env: str
    objective: str
    seed: Seed
    source: str = ""
    note: str = ""
    comparisons: Annotated[list[Comparison], Meta(min_length=1)]


class Inputs(_Part, frozen=True, kw_only=True):
    """What a cell is made of."""

    env: str
    scale: str
    objective: str
    scheduler: str
    settings: dict[str, Any]
    weights_sha256: str | None
    view: dict[str, Any]
    options: dict[str, Any]
    instances: int
    seed: int
    horizon: int
    schema: int = SCHEMA

    def problem(self) -> Problem:
        """What is played."""
        return Problem(
            self.env,
            scale=self.scale,
            count=self.instances,
            episodes=1,
            seed=self.seed,
            view=self.view,
            objective=self.objective,
            horizon=self.horizon,
            options=self.options,
        )

    @property
    def name(self) -> str:
        """16 hexadecimal digits of the SHA-256 of the inputs as canonical JSON."""
        return hashlib.sha256(msgspec.json.encode(self, order="sorted")).hexdigest()[:16]


class Cell(_Part, frozen=True, kw_only=True):
    """A finished cell.

    Attributes:
        inputs: what it was made of.
        objective: of each instance's rounds, an infeasible one charged as the domain does.
        feasible: of each instance's rounds, 1 or 0.
        visible_share: share of the graph that acting agents saw.
        privileged_info: what the scheduler uses beyond what its agents see, by the names of PrivilegedInfo.
        command: that trained it, None for a rule.
        knowledge: what its training used, in words; None for a rule.
        cpu_seconds: for all rounds, simulation included.
        revision: of the source that made it.
    """

    inputs: Inputs
    objective: list[list[float]]
    feasible: list[list[int]]
    visible_share: float
    privileged_info: list[str]
    command: str | None = None
    knowledge: str | None = None
    cpu_seconds: float
    revision: str


@dataclass(frozen=True)
class Place:
    """Where a cell stands: in which table, which row and on which scale."""

    comparison: Comparison
    entry: Entry
    scale: str
    inputs: Inputs


def as_comparisons(given: Any, where: str) -> Comparisons:
    """The list from plain data; InvalidFileError says where in `where` it is not as expected."""
    try:
        plan = msgspec.convert(given, Comparisons)
    except msgspec.ValidationError as error:
        reason, _, field = str(error).partition(" - at `$")
        raise InvalidFileError(where, field.strip("`."), f"a list of tables ({reason})") from error
    try:
        _check(plan)
    except (InvalidOptionError, UnknownNameError) as error:
        raise InvalidFileError(where, "", f"names that exist ({error})") from error
    return plan


def _check(plan: Comparisons) -> None:
    domain = get_domain(plan.env)
    domain.require_objective(plan.objective)
    for table in plan.comparisons:
        domain.make_view(table.view)
        domain.require_options(table.options)
        labels = [row.label for row in table.rows]
        if len(set(labels)) < len(labels):
            raise InvalidOptionError(f"rows of {table.title!r}: expected distinct labels")
        if table.within and table.exact is None:
            raise InvalidOptionError(f"{table.title!r}: within: expected a row that stands for the optimum: exact")
        for label in (table.baseline, *([table.exact] if table.exact is not None else [])):
            require(f"row of {table.title!r}", label, labels)
        for scale in table.instances:
            domain.require_scale(scale)
        for row in table.rows:
            for scale in (*row.instances, *row.published, *(row.scales or ())):
                require(f"scale of {row.label!r}", scale, table.instances)
            if row.scheduler is not None:
                create_scheduler(row.scheduler, domain, **row.settings)


def places(plan: Comparisons, *, quick: bool = False) -> list[Place]:
    """Every cell of a plan in the order of its tables; with `quick` on few instances."""
    found = []
    for table in plan.comparisons:
        for scale, count in table.instances.items():
            for row in table.rows:
                if row.scheduler is None or (row.scales is not None and scale not in row.scales):
                    continue
                instances = min(row.instances.get(scale, count), count)
                inputs = Inputs(
                    env=plan.env,
                    scale=scale,
                    objective=plan.objective,
                    scheduler=row.scheduler,
                    settings=row.settings,
                    weights_sha256=_weights(plan.env, row.scheduler),
                    view=view_as_json(get_domain(plan.env).make_view(table.view)),
                    options=table.options,
                    instances=max(2, instances // QUICK) if quick else instances,
                    seed=plan.seed,
                    horizon=table.horizon,
                )
                found.append(Place(table, row, scale, inputs))
    return found


def _weights(env: str, name: str) -> str | None:
    """The SHA-256 of a shipped policy's weights; None for a rule."""
    return None if name in rules(env) else shipped_policies()[name].weights_sha256


def make(inputs: Inputs) -> Cell:
    """Play a cell: one episode of each instance. Time is taken after a short episode that compiles what is needed."""
    problem = inputs.problem()
    scheduler = create_scheduler(inputs.scheduler, problem.domain, **inputs.settings)
    evaluate_scheduler(problem.but(count=min(_WARM_UP, inputs.instances), horizon=1), scheduler)
    started = time.process_time()
    scores = evaluate_scheduler(problem, scheduler)
    seconds = time.process_time() - started
    card = None if inputs.weights_sha256 is None else shipped_policies()[inputs.scheduler]
    rounds = {name: scores.per_round[name][:, 0] for name in (inputs.objective, "feasible")}
    played = [~np.isnan(row) for row in rounds[inputs.objective]]
    return Cell(
        inputs=inputs,
        objective=[row[there].tolist() for row, there in zip(rounds[inputs.objective], played, strict=True)],
        feasible=[row[there].astype(int).tolist() for row, there in zip(rounds["feasible"], played, strict=True)],
        visible_share=round(scores.visible_share, 6),
        privileged_info=scores.privileged_info.names,
        command=None if card is None else card.command,
        knowledge=None if card is None else card.training_knowledge,
        cpu_seconds=round(seconds, 4),
        revision=source_revision(),
    )


def read_cells(path: Path) -> dict[str, Cell]:
    """Cells by name; none where the file is not there. Raises InvalidFileError, with the line, for one that is none."""
    found: dict[str, Cell] = {}
    for number, line in enumerate(path.read_bytes().splitlines() if path.exists() else [], start=1):
        try:
            cell = msgspec.convert(with_names(msgspec.json.decode(line)), Cell)
        except (msgspec.DecodeError, UnknownNameError) as error:
            raise InvalidFileError(path, f"line {number}", f"a cell of schema {SCHEMA} ({error})") from error
        found[cell.inputs.name] = cell
    return found


def write_cells(path: Path, cells: Mapping[str, Cell]) -> None:
    """Write cells in the order of their names, the file as a whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(b"".join(msgspec.json.encode(cells[name]) + b"\n" for name in sorted(cells)))


def missing(wanted: Iterable[Place], cells: Mapping[str, Cell]) -> list[Place]:
    """The places whose cells are not there, each cell once."""
    return list({place.inputs.name: place for place in wanted if place.inputs.name not in cells}.values())

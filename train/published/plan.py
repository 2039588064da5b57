"""What the tables of a domain hold: `configs/published/<domain>.yaml`, and nothing else.

The YAML is converted to the classes below, whose fields have the names of its keys. A key that is not a field,
a value of another type or a name that nobody has gives one line that says where.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from omegaconf import OmegaConf

from marl_sched.agents.policies.cards import Mode
from marl_sched.agents.registry import rules
from marl_sched.domain import Domain, get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError, require

Count = Annotated[int, Meta(ge=1)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class _Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of the list; unknown keys are errors."""


class Published(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A published entry: mean and standard deviation of M1, and of M2 in percent."""

    m1: float
    m1_std: float
    m2: float
    m2_std: float


class Player(_Part, frozen=True, kw_only=True):
    """Who plays: a rule by name, or a policy by its shipped name or the path of its weights from the root.

    In a policy's name `{objective}` and `{scale}` stand for those of the entry. `command` is what trains a policy
    that is not there yet, told beside it.
    """

    label: str
    rule: str | None = None
    policy: str | None = None
    command: str = ""


class Row(Player, frozen=True, kw_only=True):
    """A scheduler of the tables.

    Attributes:
        group: `published` for the methods of the dissertation, `ours` for the others.
        view: as in `Domain.make_view`.
        options: more options of the simulator, such as a scheme.
        mode: how a policy decides, where it is not as its card says.
        objectives: in whose tables it stands; None: in all.
        scales: on which scales it plays; None: on all.
        episodes: scale -> episodes of each instance, where they are fewer than the tables'.
        published: objective -> scale -> the published entry.
        remark: printed below the tables as it is.
    """

    group: Literal["published", "ours"]
    view: dict[str, Any] = msgspec.field(default_factory=lambda: {"kind": "full"})
    options: dict[str, Any] = {}
    mode: Mode | None = None
    objectives: list[str] | None = None
    scales: list[str] | None = None
    episodes: dict[str, Count] = {}
    published: dict[str, dict[str, Published]] = {}
    remark: str = ""

    def plays(self, objective: str, scale: str) -> bool:
        """Whether the row has an entry for this objective and scale."""
        return (self.objectives is None or objective in self.objectives) and (
            self.scales is None or scale in self.scales
        )


class Line(Player, frozen=True, kw_only=True):
    """A scheduler under several views: the same rule or weights under all, or `policies`, one for each view's name."""

    policies: dict[str, str] = {}


class Decentralisation(_Part, frozen=True, kw_only=True):
    """M1 against the share of the graph that an agent sees; `views` by the names that the page gives them.

    `episodes` of each instance, where they are fewer than the tables'.
    """

    objective: str
    episodes: Count | None = None
    scales: Annotated[list[str], Meta(min_length=1)]
    views: Annotated[dict[str, dict[str, Any]], Meta(min_length=2)]
    lines: Annotated[list[Line], Meta(min_length=1)]


class Bounding(_Part, frozen=True, kw_only=True):
    """How hard to look for the upper bound: see `upper_bounds` of the domain's bound."""

    price_vectors: Count
    evaluations: Count


class Size(_Part, frozen=True, kw_only=True):
    """How much is played: instances of each scale, episodes of each instance."""

    instances: Count
    episodes: Count
    bound: Bounding


class Plan(_Part, frozen=True, kw_only=True):
    """All tables of a domain.

    Attributes:
        env: the domain's name.
        scales, objectives: the columns, and the tables.
        full, quick: two sizes; the quick one is for a look.
        measure: what M1 is, in words.
        source: where the published entries stand.
        seed: of instances and noise.
        note: what a reader has to know of this seed's instances.
        horizon: simulated time of an episode; None is the domain's default.
        rows: schedulers in the order of the tables. The domain's reference scheduler has to be one of them.
        decentralisation: the section about views.
    """

    env: str
    scales: Annotated[list[str], Meta(min_length=1)]
    objectives: Annotated[list[str], Meta(min_length=1)]
    measure: str = "the mean of the objective"
    source: str = ""
    full: Size
    quick: Size
    seed: Seed
    note: str = ""
    horizon: Count | None = None
    rows: Annotated[list[Row], Meta(min_length=1)]
    decentralisation: Decentralisation

    @property
    def domain(self) -> Domain:
        """The domain that is played."""
        return get_domain(self.env)


def shipped_list(env: str) -> tuple[dict[str, Any], str]:
    """The list that ships for a domain as plain data, and its name; InvalidOptionError if there is none."""
    get_domain(env)
    source = files("marl_sched.configs").joinpath("published", f"{env}.yaml")
    if not source.is_file():
        raise InvalidOptionError(f"--env: there are no published tables of the environment {env!r}")
    with as_file(source) as path:
        given: Any = OmegaConf.to_container(OmegaConf.load(path))
    return given, f"configs/published/{env}.yaml"


def as_plan(given: Any, where: str) -> Plan:
    """A plan from plain data; InvalidFileError says where in `where` it is not as expected."""
    try:
        plan = msgspec.convert(given, Plan)
    except msgspec.ValidationError as error:
        reason, _, field = str(error).partition(" - at `$")
        raise InvalidFileError(where, field.strip("`."), f"a list of tables ({reason})") from error
    try:
        _check(plan)
    except (InvalidOptionError, UnknownNameError) as error:
        raise InvalidFileError(where, "", f"names that exist ({error})") from error
    return plan


def _check(plan: Plan) -> None:
    """Look up every name; raises InvalidOptionError or UnknownNameError."""
    domain, views = plan.domain, plan.decentralisation.views
    objectives, scales = [*plan.objectives, plan.decentralisation.objective], [*plan.decentralisation.scales]
    for row in plan.rows:
        _check_player(row, plan.env)
        if row.mode is not None and row.policy is None:
            raise InvalidOptionError(f"mode of {row.label!r}: expected none, as a rule has no modes")
        domain.make_view(row.view)
        objectives += [*(row.objectives or ()), *row.published]
        scales += [*(row.scales or ()), *row.episodes]
        scales += [scale for entries in row.published.values() for scale in entries]
    for objective in objectives:
        require("objective of these tables", objective, plan.objectives)
    for scale in [*scales, *plan.scales]:
        domain.require_scale(require("scale of these tables", scale, plan.scales))
    for objective in plan.objectives:
        domain.require_objective(objective)
    for view in views.values():
        domain.make_view(view)
    for line in plan.decentralisation.lines:
        _check_player(line, plan.env, line.policies)
        for name in line.policies:
            require(f"view of line {line.label!r}", name, views)
    for objective in plan.objectives:
        labels = [row.label for row in plan.rows if row.objectives is None or objective in row.objectives]
        if len(set(labels)) < len(labels):
            raise InvalidOptionError(f"rows: expected distinct labels in the table of {objective}")
    if domain.reference not in [row.rule for row in plan.rows if row.view["kind"] == "full"]:
        raise InvalidOptionError(f"rows: expected one of the rule {domain.reference} with the full view")


def _check_player(player: Player, env: str, policies: dict[str, str] | None = None) -> None:
    given = [player.rule is not None, player.policy is not None, bool(policies)]
    if sum(given) != 1:
        raise InvalidOptionError(f"{player.label!r}: expected exactly one of rule, policy or (in a line) policies")
    if player.rule is not None:
        require(f"rule of {player.label!r}", player.rule, rules(env))

"""The registry of domains: what a domain declares so that every environment API, policy and command works with it.

A domain of another distribution is found by its entry point (marl_sched.plugins) and costs no line here; those that
ship with the package are named in `marl_sched.envs`. A domain is imported when it is asked for by name, and the parts
that it declares as `Lazy` when they are used.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

import numpy as np

from marl_sched.domain_parts import CentralInterface, Demo, Telemetry
from marl_sched.errors import InvalidOptionError, MarlSchedError, require
from marl_sched.plugins import DOMAINS, import_object, load_offered, offered
from marl_sched.privileged import PrivilegedInfo

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from marl_sched.graph import GraphSpec
    from marl_sched.noise import Split
    from marl_sched.planning import Advice, Schedules
    from marl_sched.sheets import Sheet
    from marl_sched.simulation import TurnSimulator


def _none_known(instance: Any) -> list[str]:
    """No instance of a domain that does not say otherwise is known to be impossible."""
    return []


def _json_files(folder: Path) -> list[Path]:
    """The JSON files of a folder, sorted."""
    return sorted(folder.glob("*.json"))


@dataclass(frozen=True, kw_only=True)
class Domain:
    """One scheduling problem as the rooms see it.

    Attributes:
        name: as in `--env`.
        title: one line for `marl-sched list`.
        scales: the instance generator's settings by name, smallest first.
        objectives: names of the rewards to choose from, the default first.
        views: view name -> dataclass of the view's options, which are ints and floats.
        agent_prefix: agents are called `<prefix>_<i>`.
        generate: (scale, rng) -> instance.
        load: path -> instance; raises InvalidFileError.
        decode: (plain data, where) -> the instance that its `as_json` wrote; InvalidFileError names `where`.
        instance_type: the class of its instances.
        simulator: (instances, **options) -> TurnSimulator. Every domain understands the options `view`,
            `objective`, `horizon`, `seed` and `pad` (a scale's name whose largest instance sets the padding,
            or None: the largest of the given instances); unknown options raise TypeError.
        central: the centralised Gymnasium environment.
        render: mode -> function of a simulator row, `ansi` gives str, `rgb_array` gives uint8 (H, W, 3).
        render_options: render mode -> options that a simulator must be made with to be drawn so.
        default_horizon: simulated time of an episode.
        unit: what the simulated time of an episode counts, in the plural, as results and tables name it.
        better: whether a scheduler with a higher or a lower M1 is the better one.
        headline: measures without which M1 says little, such as the share of feasible rounds; tables show them first.
        objective_words: what an objective is, where its name alone misleads: name -> words for titles.
        longest: instance -> the most units of time that an episode of it has, where instances limit it; None: they do
            not. A longer horizon is refused where somebody asks for it.
        telemetry: how the state travels to deployed agents; None: the domain cannot be deployed.
        reference: name of the scheduler over which M2 is the gain; None: results have no M2.
        schedulers: scheduler's name -> factory, or `package.module:attribute` of such a table; more may be added by
            entry points of the group `marl_sched.schedulers`.
        hidden_info: what nobody can know in the field, such as by which chances things fail. Tables hold no rule that
            knows it against the others.
        feasible: instance -> whether a schedule of it can be feasible, found by search; None: nothing tells.
        benchmarks: (domain, batch) -> what `marl-sched bench` measures of this domain alone; None: nothing.
        bound: the module, by its name, that proves upper bounds (`Relaxation` and `upper_bounds`); None: none is known.
        bound_info: what the bound knows, and so holds for every scheduler that knows no more.
        generate_accepted: (scale, rng, accept) -> an instance that `accept` takes, redrawn until it does; None:
            every generated instance can be solved.
        instance_files: folder -> the files in it that should hold an instance each, sorted.
        save_schedules: (simulator, row, path without suffix) -> the files it wrote of a row's ended rounds, for an
            independent check; None: the domain has no such files.
        schedules: what `marl-sched schedule` and `validate` need; None: its episodes have no schedules.
        solver_bound: (instance, objective, time_limit) -> what a solver proves of the first round: `bound` (None where
            nothing can be proved), `status`, `seconds`; None: there is no such solver.
        impossibilities: instance -> why no schedule of it can be feasible, a sentence each; empty if none is known.
        advice: what `marl-sched advise` tells; None: nothing.
        sheet: how an instance stands in a spreadsheet; None: `marl-sched import` cannot read it.
        records: the spreadsheet of what `marl-sched fit` estimates parameters from; reading it gives a `Fitted`; None:
            there is nothing to fit.
        demo: what `marl-sched demo` shows; None: nothing.
        pressing: (metagraph, observation of it) -> the legal actions, bool (B, n_actions), one of which a greedy policy
            takes before it does nothing; None: there are none such.
        episode_figure: (episodes, title=) -> a figure with a panel for each of the finished episodes, caption ->
            simulator, all on one axis of time; None: the `rgb_array` pictures are put one above the other.
        frames: a finished episode's simulator -> its moving picture, uint8 (H, W, 3) one after the other; None: it
            has none.
        legend: what the colours of the `rgb_array` picture mean, meaning -> RGB in 0 .. 255; None: it needs none.
        best_of: (trained policy, number of samples) -> a scheduler that follows the best of the policy's sampled
            schedules, `NAME@samples=K` for users; None: the domain has no such thing.
        band: what a band of the `rgb_array` picture is and how many pixels high, such as ("plane", 4); None: the
            picture brings axes of its own.
    """

    name: str
    title: str
    scales: Mapping[str, Any]
    objectives: tuple[str, ...]
    views: Mapping[str, type]
    agent_prefix: str
    generate: Callable[[str, np.random.Generator], Any]
    load: Callable[[Path], Any]
    decode: Callable[[Any, str | Path], Any]
    instance_type: type
    simulator: Callable[..., TurnSimulator]
    central: CentralInterface
    render: Mapping[str, Callable[[Any, int], Any]]
    default_horizon: int
    headline: tuple[str, ...] = ()
    objective_words: Mapping[str, str] = field(default_factory=dict)
    longest: Callable[[Any], int] | None = None
    telemetry: Telemetry | None = None
    render_options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    unit: str = "hours"
    better: Literal["higher", "lower"] = "higher"
    reference: str | None = None
    schedulers: Mapping[str, Callable[..., Any]] | str = field(default_factory=dict)
    hidden_info: PrivilegedInfo = PrivilegedInfo.NONE
    feasible: Callable[[Any], bool] | None = None
    benchmarks: Callable[[Any, int], Mapping[str, Any]] | None = None
    bound: str | None = None
    bound_info: PrivilegedInfo = PrivilegedInfo.NONE
    best_of: Callable[[Any, int], Any] | None = None
    generate_accepted: Callable[[str, np.random.Generator, Callable[[Any], bool]], Any] | None = None
    impossibilities: Callable[[Any], list[str]] = _none_known
    instance_files: Callable[[Path], list[Path]] = _json_files
    save_schedules: Callable[[Any, int, Path], list[Path]] | None = None
    schedules: Schedules | None = None
    solver_bound: Callable[[Any, str, float | None], dict[str, Any]] | None = None
    advice: Advice | None = None
    sheet: Sheet | None = None
    records: Sheet | None = None
    demo: Demo | None = None
    pressing: Callable[[GraphSpec, Mapping[str, np.ndarray]], np.ndarray] | None = None
    episode_figure: Callable[..., Figure] | None = None
    frames: Callable[[Any], Iterable[np.ndarray]] | None = None
    legend: Mapping[str, Sequence[int]] | None = None
    band: tuple[str, int] | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Domain:
        """Itself: a domain never changes."""
        return self

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickled by name where it is registered, since it holds functions that cannot be pickled."""
        return (get_domain, (self.name,)) if _DOMAINS.get(self.name) is self else super().__reduce_ex__(protocol)

    def in_words(self, objective: str, length: str) -> str:
        """What M1 is, for titles: `mean profit over 720 hours; higher is better`."""
        return f"mean {self.objective_words.get(objective, objective)} over {length}; {self.better} is better"

    def agent_name(self, agent: int) -> str:
        """`crew_3` for agent 3 of a domain whose agents are crews."""
        return f"{self.agent_prefix}_{agent}"

    def agent_names(self, instance: Any, count: int) -> list[str]:
        """What an instance's agents are called: by its own `agent_names` where it has them, else `agent_name`."""
        return list(getattr(instance, "agent_names", ())) or [self.agent_name(i) for i in range(count)]

    @property
    def default_scale(self) -> str:
        """The scale where none is named: the smallest."""
        return next(iter(self.scales))

    def largest_scale(self, scales: Iterable[str]) -> str:
        """The largest of these scales, whose padding fits the instances of all; UnknownNameError for another name."""
        return max(map(self.require_scale, scales), key=list(self.scales).index)

    def instances(self, scale: str, count: int, seed: int, split: Split = "test") -> list[Any]:
        """`count` instances of a scale; instance i depends on (seed, split, i) alone (marl_sched.noise).

        Raises UnknownNameError for the scale or the split, InvalidOptionError for a seed outside [0, 2**63).
        """
        from marl_sched.noise import instance_generator

        self.require_scale(scale)
        return [self.generate(scale, instance_generator(seed, i, split)) for i in range(count)]

    def require_scale(self, scale: str) -> str:
        """The scale's name, or UnknownNameError."""
        return require(f"scale of {self.name}", scale, self.scales)

    def require_objective(self, objective: str) -> str:
        """The objective's name, or UnknownNameError; one from outside may be named (marl_sched.objective)."""
        from marl_sched.objective import objective_names, outside_objective

        if outside_objective(self, objective) is not None:
            return objective
        return require(f"objective of {self.name}", objective, [*self.objectives, *objective_names(self.name)])

    def make_simulator(self, instances: Sequence[Any], **options: Any) -> TurnSimulator:
        """The domain's simulator of these instances; an objective from outside pays its rewards, if it is asked for."""
        from marl_sched.objective import ScoredSimulator, outside_objective

        name = str(options.get("objective", self.objectives[0]))
        outside = outside_objective(self, name)
        if outside is None:
            return self.simulator(instances, **options)
        return ScoredSimulator(self.simulator(instances, **{**options, "objective": self.objectives[0]}), name, outside)

    @property
    def simulator_options(self) -> dict[str, Any]:
        """The simulator's own options, those that no other word of a `Problem` stands for: name -> default."""
        parameters = inspect.signature(self.simulator).parameters.values()
        return {one.name: one.default for one in parameters if one.name not in _NAMED_BY_PROBLEM}

    def view_options(self, kind: str) -> dict[str, Any]:
        """The options of a view of that kind: name -> default; UnknownNameError for a kind that there is not."""
        view_type = self.views[require(f"view of {self.name}", kind, self.views)]
        return {option.name: option.default for option in fields(view_type)}

    def require_options(self, options: Mapping[str, Any]) -> None:
        """UnknownNameError for an option that the domain's simulator does not have; it checks the values itself."""
        for name in options:
            require(f"option of {self.name}", name, self.simulator_options)

    def view(self, kind: str, /, **options: Any) -> Any:
        """The view of that kind with those options; raises as `make_view`."""
        return self.make_view({"kind": kind, **options})

    def make_view(self, given: Any) -> Any:
        """A view from None (full), its kind, `{"kind": kind, **options}`, or itself.

        Raises UnknownNameError for a kind that the domain does not have. Raises InvalidOptionError for an option
        that the kind does not have, a value of another type, a number that is not finite or outside the option's
        bounds, and for anything else that does not describe a view.
        """
        if isinstance(given, tuple(self.views.values())):
            return given
        words = {"kind": "full"} if given is None else {"kind": given} if isinstance(given, str) else given
        if not isinstance(words, Mapping) or "kind" not in words:
            raise InvalidOptionError(f"view: expected one of {', '.join(self.views)} or a view object, got {given!r}")
        kind = require(f"view of {self.name}", words["kind"], self.views)
        view_type = self.views[kind]
        types = get_type_hints(view_type)
        known = [option.name for option in fields(view_type)]
        options = {name: value for name, value in words.items() if name != "kind"}
        for name, value in options.items():
            if name not in known:
                has = ", ".join(known) or "none"
                raise InvalidOptionError(f"view {kind}: {name}: expected an option of this view of {self.name}: {has}")
            options[name] = _as_number(f"view {kind}: {name}", value, types[name])
        return view_type(**options)


def _as_number(where: str, value: Any, kind: type) -> Any:
    """A finite int or float as a view's field has it; a whole number counts as an int however it is written."""
    finite = not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)
    if not finite or kind(value) != value:
        expected = "an integer" if kind is int else "a finite number"
        raise InvalidOptionError(f"{where}: expected {expected}, got {value!r}")
    return kind(value)


# Arguments of every domain's simulator that have fields of their own in a Problem.
_NAMED_BY_PROBLEM = frozenset({"instances", "view", "objective", "horizon", "seed", "pad"})

_DOMAINS: dict[str, Domain] = {}


def register(domain: Domain) -> Domain:
    """Make a domain known by its name; a name can be taken once."""
    if domain.name in _DOMAINS:
        raise ValueError(f"domain {domain.name!r} is registered already")
    _DOMAINS[domain.name] = domain
    return domain


def get_domain(name: str) -> Domain:
    """The domain of that name, imported now if it was not before; UnknownNameError lists the known ones.

    Raises MarlSchedError for an entry point that does not lead to a domain of its name.
    """
    if name in _DOMAINS:
        return _DOMAINS[name]
    require("environment", name, domain_names())
    shipped = _shipped()
    found = import_object(shipped[name]) if name in shipped else load_offered(offered(DOMAINS)[name])
    if not isinstance(found, Domain) or found.name != name:
        raise MarlSchedError(f"entry point {name} of {DOMAINS}: expected a Domain of that name, got {found!r}")
    return _DOMAINS.setdefault(name, found)


def domain_names() -> list[str]:
    """Names of all domains that can be had, without importing them: those of the package first, the others sorted."""
    shipped = list(_shipped())
    return shipped + sorted({*_DOMAINS, *offered(DOMAINS)} - set(shipped))


def _shipped() -> Mapping[str, str]:
    from marl_sched import envs

    return envs.DOMAINS

"""Schedulers by name: a domain's rules, the policies that ship with the package, and checkpoints by path.

A domain's rules stand in one table (`Domain.schedulers`); any distribution adds to it by entry points of the group
`marl_sched.schedulers`, named `<domain>.<scheduler>`. A scheduler of no table is named as `package.module:factory`.
All of it is imported when it is asked for, PyTorch only when a policy is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from marl_sched.agents.base import ObservationScheduler, Scheduler
from marl_sched.agents.policies.cards import Mode, PolicyCard, read_card
from marl_sched.domain import Domain, domain_names, get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError, MarlSchedError, UnknownNameError, require
from marl_sched.light import Runtime
from marl_sched.plugins import SCHEDULERS, import_object, is_object_name, load_offered, offered

if TYPE_CHECKING:
    from marl_sched.agents.networks.planner import TrainedPlanner
    from marl_sched.agents.policies.network_policy import RecurrentPolicy
    from marl_sched.agents.policies.onnx_policy import OnnxRecurrentPolicy
    from marl_sched.agents.policies.trained import LogitsPolicy
    from marl_sched.graph import GraphSpec

    AnyPolicy = LogitsPolicy | RecurrentPolicy | OnnxRecurrentPolicy | TrainedPlanner

SHIPPED = Path(__file__).resolve().parent / "policies" / "shipped"
_SUFFIXES = (".safetensors", ".json")


def rules(domain: Domain | str) -> Mapping[str, Callable[..., Scheduler]]:
    """The rules of a domain, name -> factory: its own table, then those that other distributions offer, sorted.

    Raises InvalidOptionError where an offered one has the name of another.
    """
    domain = domain if isinstance(domain, Domain) else get_domain(domain)
    table = domain.schedulers
    found = dict(import_object(table) if isinstance(table, str) else table)
    for name, point in sorted(offered(SCHEDULERS).items()):
        owner, _, scheduler = name.partition(".")
        if owner != domain.name:
            continue
        if scheduler in found:
            raise InvalidOptionError(f"{SCHEDULERS}: {name}: expected a name that {owner} does not have yet")
        found[scheduler] = partial(_create_offered, point)
    return found


def _create_offered(point: EntryPoint, **options: Any) -> Scheduler:
    return load_offered(point)(**options)


def feasibility(domain: Domain | str) -> Callable[[Any], bool] | None:
    """What tells whether an instance is feasible (`Domain.feasible`); None: nothing."""
    return (domain if isinstance(domain, Domain) else get_domain(domain)).feasible


@cache
def shipped_policies() -> Mapping[str, PolicyCard]:
    """The cards of the policies that ship with the package, by name, sorted."""
    return {path.stem: read_card(path) for path in sorted(SHIPPED.glob("*.json"))}


def scheduler_names(domain: str) -> list[str]:
    """Names of a domain's rules, in the order of its table, then of its shipped policies."""
    return [*rules(domain), *(name for name, card in shipped_policies().items() if card.domain == domain)]


def create_scheduler(
    name_or_path: str | Path, domain: Domain | str, *, runtime: Runtime = "torch", **options: Any
) -> Scheduler:
    """The scheduler of that name, of that `package.module:factory`, or the policy in that file, for a domain.

    `runtime` is what runs a policy's network, see `load_policy`; rules have none. `options` are those of the rule, or
    of `load_policy`; unknown ones raise TypeError. With `samples` the best of so many schedules that a policy samples
    is followed, where the domain has such a thing (`Domain.best_of`). Raises UnknownNameError for a name that nobody
    has, and InvalidFileError for a file that is damaged or holds another domain's policy.
    """
    domain_name = domain if isinstance(domain, str) else domain.name
    table = rules(domain_name)
    if str(name_or_path) in table:
        return table[str(name_or_path)](**options)
    if is_object_name(str(name_or_path)):
        return _create_named(str(name_or_path), options)
    _require_known(name_or_path, domain_name)
    samples = options.pop("samples", None)
    policy = load_policy(name_or_path, runtime=runtime, **options)
    if policy.card is not None and policy.card.domain != domain_name:
        card_path = Path(name_or_path).with_suffix(".json")
        raise InvalidFileError(card_path, "domain", f"a policy for {domain_name}", policy.card.domain)
    return policy if samples is None else _best_of(policy, samples, domain_name)


def _best_of(policy: Scheduler, samples: int, domain: str) -> Scheduler:
    """What follows the best of so many samples of a policy; InvalidOptionError where there is no such thing."""
    from marl_sched.agents.networks.planner import TrainedPlanner

    if isinstance(policy, TrainedPlanner):
        return policy.best_of(samples)
    best_of = get_domain(domain).best_of
    if best_of is None:
        raise InvalidOptionError(f"scheduler {policy.name}: samples: schedules of {domain} are not sampled")
    if not isinstance(policy, ObservationScheduler):
        raise InvalidOptionError(f"scheduler {policy.name}: samples: expected a policy without a memory")
    made: Scheduler = best_of(policy, samples)
    return made


def _create_named(where: str, options: Mapping[str, Any]) -> Scheduler:
    """The scheduler that a factory, named as `package.module:factory`, makes; InvalidOptionError if it is none."""
    made = import_object(where)(**options)
    if not isinstance(made, Scheduler):
        raise InvalidOptionError(f"{where}: expected a factory of a Scheduler, got {type(made).__name__}")
    return made


def load_policy(
    name_or_path: str | Path,
    *,
    mode: Mode | None = None,
    graph: GraphSpec | None = None,
    runtime: Runtime = "torch",
    **options: Any,
) -> AnyPolicy:
    """A trained policy by its shipped name, or by the path of its weights or its card.

    `mode` is `greedy` or `sample`, None: as its card says. One whose network has a memory is a RecurrentScheduler, one
    that plans whole rounds a TrainedPlanner, to which `options` go. With a `graph` a policy that was trained on another
    metagraph is refused. `runtime` is what runs its network: `torch`, or `onnx`, onnxruntime on the NAME.onnx beside
    the card. Raises UnknownNameError for a name that does not ship, InvalidFileError for damaged files, MarlSchedError
    without the runtime.
    """
    path = policy_path(name_or_path)
    require("runtime", runtime, get_args(Runtime))
    try:
        if runtime == "onnx":
            from marl_sched.agents.policies.onnx_policy import load_onnx

            return load_onnx(path, mode=mode, graph=graph, **options)
        from marl_sched.agents.policies.network_policy import NetworkPolicy

        return NetworkPolicy.load(path, mode=mode, graph=graph, **options)
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors", "onnxruntime"):
            raise
        extra = "light" if error.name == "onnxruntime" else "policies"
        raise MarlSchedError(
            f"policy {name_or_path}: expected {error.name} to be installed: pip install 'marl-sched[{extra}]'"
        ) from error


def card_of(name_or_path: str | Path, domain: Domain | str) -> PolicyCard | None:
    """What a trained policy's card says, without loading it; None for a rule.

    Raises UnknownNameError for a name that nobody has, InvalidFileError for a damaged card.
    """
    domain_name = domain if isinstance(domain, str) else domain.name
    if str(name_or_path) in rules(domain_name) or is_object_name(str(name_or_path)):
        return None
    _require_known(name_or_path, domain_name)
    return read_card(policy_path(name_or_path).with_suffix(".json"))


def policy_path(name_or_path: str | Path) -> Path:
    """Where a policy's weights or card are: a path as it is, a shipped name in its folder.

    Raises UnknownNameError for a name that does not ship, InvalidOptionError for the name of a rule.
    """
    if _is_path(name_or_path):
        return Path(name_or_path)
    if str(name_or_path) in shipped_policies():
        return SHIPPED / f"{name_or_path}.safetensors"
    for domain in domain_names():
        if str(name_or_path) in rules(domain):
            raise InvalidOptionError(
                f"policy {name_or_path}: expected a trained policy, but this is a rule of {domain}: "
                f"marl_sched.agents.create_scheduler({str(name_or_path)!r}, {domain!r}) makes it"
            )
    raise UnknownNameError("policy", str(name_or_path), shipped_policies())


def _require_known(name_or_path: str | Path, domain: str) -> None:
    """UnknownNameError for a name, not a path, that no scheduler has, InvalidOptionError for another domain's."""
    name = str(name_or_path)
    if _is_path(name_or_path) or name in scheduler_names(domain):
        return
    for other in domain_names():
        if name in scheduler_names(other):
            known = ", ".join(scheduler_names(domain))
            raise InvalidOptionError(f"scheduler {name}: is one of {other}, expected one of {domain}: {known}")
    raise UnknownNameError("scheduler", name, scheduler_names(domain))


def is_policy(name_or_path: str | Path) -> bool:
    """Whether that is the name of a policy that ships, or the path of one."""
    return _is_path(name_or_path) or str(name_or_path) in shipped_policies()


def _is_path(name_or_path: str | Path) -> bool:
    """Whether a policy is given by its file: names have no folder and no suffix of a policy's files."""
    path = Path(name_or_path)
    return isinstance(name_or_path, Path) or path.suffix in _SUFFIXES or len(path.parts) > 1

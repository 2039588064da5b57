"""Schedulers by name: a domain's rules, the policies that ship with the package, and checkpoints by path.

A domain's rules stand in one table, `RULES` (name -> factory), in `marl_sched.agents.<domain>.schedulers`, which is
imported when it is asked for; where instances may be infeasible, `IS_FEASIBLE` there tells. PyTorch is imported only
when a policy is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_sched.agents.base import Scheduler
from marl_sched.agents.policies.cards import Mode, PolicyCard, read_card
from marl_sched.domain import Domain
from marl_sched.errors import InvalidFileError, MarlSchedError, UnknownNameError

if TYPE_CHECKING:
    from marl_sched.agents.policies.network_policy import NetworkPolicy
    from marl_sched.graph import GraphSpec

SHIPPED = Path(__file__).resolve().parent / "policies" / "shipped"
_SUFFIXES = (".safetensors", ".json")


def rules(domain: str) -> Mapping[str, Callable[..., Scheduler]]:
    """The rules of a domain, name -> factory; empty for a domain without any."""
    module = f"marl_sched.agents.{domain}.schedulers"
    if find_spec(f"marl_sched.agents.{domain}") is None or find_spec(module) is None:
        return {}
    return import_module(module).RULES


def feasibility(domain: str) -> Callable[[Any], bool] | None:
    """What tells whether an instance is feasible: `IS_FEASIBLE` beside the domain's rules; None: nothing."""
    module = f"marl_sched.agents.{domain}.schedulers"
    if find_spec(f"marl_sched.agents.{domain}") is None or find_spec(module) is None:
        return None
    return getattr(import_module(module), "IS_FEASIBLE", None)


@cache
def shipped_policies() -> Mapping[str, PolicyCard]:
    """The cards of the policies that ship with the package, by name, sorted."""
    return {path.stem: read_card(path) for path in sorted(SHIPPED.glob("*.json"))}


def scheduler_names(domain: str) -> list[str]:
    """Names of a domain's rules, in the order of its table, then of its shipped policies."""
    return [*rules(domain), *(name for name, card in shipped_policies().items() if card.domain == domain)]


def create_scheduler(name_or_path: str | Path, domain: Domain | str, **options: Any) -> Scheduler:
    """The scheduler of that name, or the policy in that file, for a domain.

    `options` are those of the rule, or of `load_policy`; unknown ones raise TypeError. Raises
    UnknownNameError for a name that nobody has, and InvalidFileError for a file that is damaged or holds
    another domain's policy.
    """
    domain_name = domain if isinstance(domain, str) else domain.name
    table = rules(domain_name)
    if str(name_or_path) in table:
        return table[str(name_or_path)](**options)
    _require_known(name_or_path, domain_name)
    policy = load_policy(name_or_path, **options)
    if policy.card is not None and policy.card.domain != domain_name:
        card_path = Path(name_or_path).with_suffix(".json")
        raise InvalidFileError(card_path, "domain", f"a policy for {domain_name}", policy.card.domain)
    return policy


def load_policy(name_or_path: str | Path, *, mode: Mode | None = None, graph: GraphSpec | None = None) -> NetworkPolicy:
    """A trained policy by its shipped name, or by the path of its weights or its card.

    `mode` is `greedy` or `sample`, None: as its card says. With a `graph` a policy that was trained on another
    metagraph is refused. Raises UnknownNameError for a name that does not ship, InvalidFileError for damaged
    files, MarlSchedError without PyTorch.
    """
    path = policy_path(name_or_path)
    try:
        from marl_sched.agents.policies.network_policy import NetworkPolicy
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise MarlSchedError(
            f"policy {name_or_path}: expected {error.name} to be installed: pip install 'marl-sched[train]'"
        ) from error
    return NetworkPolicy.load(path, mode=mode, graph=graph)


def card_of(name_or_path: str | Path, domain: Domain | str) -> PolicyCard | None:
    """What a trained policy's card says, without loading it; None for a rule.

    Raises UnknownNameError for a name that nobody has, InvalidFileError for a damaged card.
    """
    domain_name = domain if isinstance(domain, str) else domain.name
    if str(name_or_path) in rules(domain_name):
        return None
    _require_known(name_or_path, domain_name)
    return read_card(policy_path(name_or_path).with_suffix(".json"))


def policy_path(name_or_path: str | Path) -> Path:
    """Where a policy's weights or card are: a path as it is, a shipped name in its folder.

    Raises UnknownNameError for a name that does not ship.
    """
    if _is_path(name_or_path):
        return Path(name_or_path)
    if str(name_or_path) in shipped_policies():
        return SHIPPED / f"{name_or_path}.safetensors"
    raise UnknownNameError("policy", str(name_or_path), shipped_policies())


def _require_known(name_or_path: str | Path, domain: str) -> None:
    """UnknownNameError for a name, not a path, that no scheduler of the domain has."""
    if not _is_path(name_or_path) and str(name_or_path) not in scheduler_names(domain):
        raise UnknownNameError("scheduler", str(name_or_path), scheduler_names(domain))


def _is_path(name_or_path: str | Path) -> bool:
    """Whether a policy is given by its file: names have no folder and no suffix of a policy's files."""
    path = Path(name_or_path)
    return isinstance(name_or_path, Path) or path.suffix in _SUFFIXES or len(path.parts) > 1

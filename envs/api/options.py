"""What users pass to an environment API, brought to what a simulator takes; every refusal names the option."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from marl_sched.domain import Domain, get_domain
from marl_sched.errors import InvalidOptionError


def as_domain(domain: str | Domain) -> Domain:
    """A domain from its name, or itself; UnknownNameError lists the known names."""
    return domain if isinstance(domain, Domain) else get_domain(domain)


def as_instance(domain: Domain, instance: Any) -> Any:
    """An instance from a path to its file, or itself; InvalidOptionError for anything else."""
    if isinstance(instance, str | Path):
        return domain.load(Path(instance))
    if not isinstance(instance, domain.instance_type):
        expected = domain.instance_type.__name__
        raise InvalidOptionError(f"instance: expected {expected} or a file's path, got {type(instance).__name__}")
    return instance


def all_options(constructor: Callable[..., Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that were given and the defaults of those that were not, as an environment API's signature has them.

    Raises TypeError for an option that the signature does not have.
    """
    bound = inspect.signature(constructor).bind(**given)
    bound.apply_defaults()
    return dict(bound.arguments)

"""What users pass to an environment API, brought to what a simulator takes; every refusal names the option."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from marl_sched.domain import Domain, get_domain
from marl_sched.problem import as_instance

__all__ = ["all_options", "as_domain", "as_instance"]


def as_domain(domain: str | Domain) -> Domain:
    """A domain from its name, or itself; UnknownNameError lists the known names."""
    return domain if isinstance(domain, Domain) else get_domain(domain)


def all_options(constructor: Callable[..., Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that were given and the defaults of those that were not, as an environment API's signature has them.

    Raises TypeError for an option that the signature does not have.
    """
    bound = inspect.signature(constructor).bind(**given)
    bound.apply_defaults()
    return dict(bound.arguments)

"""What users pass to a face, brought to what a simulator takes; every refusal names the option."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marl_sched.domain import Domain, get_domain
from marl_sched.errors import InvalidOptionError, require


def as_domain(domain: str | Domain) -> Domain:
    """A domain from its name, or itself; UnknownNameError lists the known names."""
    return domain if isinstance(domain, Domain) else get_domain(domain)


def as_view(domain: Domain, view: Any) -> Any:
    """A view from None (full), its name, `{"kind": name, **options}` or itself.

    Raises UnknownNameError for a name, InvalidOptionError for anything else that is not a view of the domain.
    """
    if isinstance(view, tuple(domain.views.values())):
        return view
    given = {"kind": "full"} if view is None else {"kind": view} if isinstance(view, str) else view
    if not isinstance(given, Mapping) or "kind" not in given:
        raise InvalidOptionError(f"view: expected one of {', '.join(domain.views)} or a view object, got {view!r}")
    kind, options = given["kind"], {name: value for name, value in given.items() if name != "kind"}
    view_type = domain.views[require(f"view of {domain.name}", kind, domain.views)]
    try:
        return view_type(**options)
    except TypeError as error:
        raise InvalidOptionError(f"view {kind}: {error}") from error


def as_instance(domain: Domain, instance: Any) -> Any:
    """An instance from a path to its file, or itself; InvalidOptionError for anything else."""
    if isinstance(instance, str | Path):
        return domain.load(Path(instance))
    if not isinstance(instance, domain.instance_type):
        expected = domain.instance_type.__name__
        raise InvalidOptionError(f"instance: expected {expected} or a file's path, got {type(instance).__name__}")
    return instance


def as_seed(seed: Any) -> int:
    """A seed as int in [0, 2**63); InvalidOptionError otherwise."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise InvalidOptionError(f"seed: expected an integer in [0, 2**63), got {seed!r}")
    return int(seed)

"""What users pass to an environment, brought to what a simulator takes; every refusal names the option."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from marl_sched.domain import Domain, get_domain
from marl_sched.envs.api.layout import MaskPlace
from marl_sched.noise import Split
from marl_sched.problem import as_instance

__all__ = ["ENVIRONMENT_DEFAULTS", "EnvironmentOptions", "as_domain", "as_instance", "with_defaults"]


def as_domain(domain: str | Domain) -> Domain:
    """A domain from its name, or itself; UnknownNameError lists the known names."""
    return domain if isinstance(domain, Domain) else get_domain(domain)


class EnvironmentOptions(TypedDict, total=False):
    """Options that the PettingZoo environments of every domain have; a domain's own type adds to them."""

    horizon: int
    seed: int | None
    split: Split
    flat: bool
    mask: MaskPlace
    pad_agents: bool


ENVIRONMENT_DEFAULTS: EnvironmentOptions = {
    "seed": None,
    "split": "train",
    "flat": False,
    "mask": "both",
    "pad_agents": False,
}


def with_defaults(defaults: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that were given and the defaults of the others; TypeError for one that has no default."""
    for name in given:
        if name not in defaults:
            raise TypeError(f"unknown option {name!r}; known: {', '.join(defaults)}")
    return {**defaults, **given}

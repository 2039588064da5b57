"""What users pass to an environment, brought to a `Problem`; every refusal names the option."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, Final, TypedDict

from marl_sched.domain import Domain, get_domain
from marl_sched.envs.api.layout import MaskPlace
from marl_sched.errors import InvalidOptionError
from marl_sched.noise import Split, fresh_seed
from marl_sched.problem import Problem

__all__ = ["ENVIRONMENT_DEFAULTS", "OF_DOMAIN", "DefaultScale", "EnvironmentOptions", "as_problem", "with_defaults"]


class DefaultScale(Enum):
    """The default of an environment's `scale`, where None already means: pad to the given instances."""

    OF_DOMAIN = "the domain's smallest"


OF_DOMAIN: Final = DefaultScale.OF_DOMAIN


def as_problem(
    domain: str | Domain,
    *,
    scale: str | DefaultScale | None,
    instances: Sequence[Any] | None,
    count: int,
    seed: int | None,
    options: Mapping[str, Any],
    **arguments: Any,
) -> Problem:
    """The problem that an environment's options state.

    Args:
        domain: a registered domain or its name.
        scale: of generated instances, and whose largest instance sets the padding; None pads to `instances`.
        instances: objects or files; None: some of the scale are drawn.
        count: how many are drawn.
        seed: None draws one from the operating system's entropy.
        options: of the domain's simulator.
        arguments: what else `Problem` takes.

    Raises TypeError for an option that the simulator does not have, otherwise as Problem.
    """
    domain = domain if isinstance(domain, Domain) else get_domain(domain)
    if scale is None and instances is None:
        raise InvalidOptionError("scale: expected a scale's name where no instance is given")
    for name in options:
        if name not in domain.simulator_options:
            raise TypeError(f"unknown option {name!r}; known: {', '.join(domain.simulator_options) or 'none'}")
    scale = domain.default_scale if isinstance(scale, DefaultScale) else scale
    source = {"instances": instances} if instances is not None else {"scale": scale, "count": count}
    return Problem(
        domain,
        **source,
        pad=scale,
        seed=fresh_seed() if seed is None else seed,
        options=options,
        **arguments,
    )


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

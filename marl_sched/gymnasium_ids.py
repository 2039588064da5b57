"""The names under which Gymnasium knows the centralised environments; importing `marl_sched` and
Gymnasium, in either order, registers them.

A domain of another distribution is known by its entry point: `couriers` as `marl_sched/Couriers-v0`, `night-shift` as
`marl_sched/NightShift-v0`. Nothing is imported here: an environment's module is loaded when it is made.
"""

from __future__ import annotations

import re

import gymnasium

from marl_sched.plugins import DOMAINS as ENTRY_POINTS
from marl_sched.plugins import offered

DOMAINS = {"marl_sched/AirME-v0": "airme", "marl_sched/MuRSE-v0": "murse", "marl_sched/Ward-v0": "ward"}


def register() -> None:
    """Make `gymnasium.make("marl_sched/AirME-v0")` and its siblings work, those of plug-ins included."""
    plugins = {gymnasium_id(name): name for name in offered(ENTRY_POINTS)}
    for name, domain in {**plugins, **DOMAINS}.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name, entry_point="marl_sched.envs.api.gymnasium_env:SchedulingEnv", kwargs={"domain": domain}
            )


def gymnasium_id(domain: str) -> str:
    """The name of a plug-in's environment: the words of the domain's name, each with a capital."""
    return f"marl_sched/{''.join(word.capitalize() for word in re.split('[-_. ]+', domain))}-v0"

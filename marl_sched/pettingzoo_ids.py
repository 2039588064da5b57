"""The names under which PettingZoo's registry knows the environments, where the installed PettingZoo has one.

import pettingzoo
import marl_sched                                # registers marl_sched/AirME-v0 for "aec" and "parallel"

env = pettingzoo.make("aec", "marl_sched/AirME-v0", scale="small")
"""

from __future__ import annotations

from importlib.util import find_spec

PAGES = {
    "marl_sched/AirME-v0": "marl_sched.airme_v0",
    "marl_sched/MuRSE-v0": "marl_sched.murse_v0",
    "marl_sched/Ward-v0": "marl_sched.ward_v0",
}


def register() -> None:
    """Make `pettingzoo.make("aec", name)` and `"parallel"` work, where PettingZoo has a registry."""
    if find_spec("pettingzoo.env_registry") is None:
        return
    from pettingzoo.env_registry.registration import aec_registry, parallel_registry
    from pettingzoo.env_registry.registration import register as add

    for name, page in PAGES.items():
        if name not in aec_registry:
            add("aec", name, f"{page}:env")
        if name not in parallel_registry:
            add("parallel", name, f"{page}:parallel_env")

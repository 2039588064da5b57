"""The names under which Gymnasium knows the centralised environments; importing `marl_sched` registers them.

Nothing heavy is imported here: an environment's module is loaded when it is made.
"""

from __future__ import annotations

import gymnasium

DOMAINS = {"marl_sched/AirME-v0": "airme", "marl_sched/MuRSE-v0": "murse"}


def register() -> None:
    """Make `gymnasium.make("marl_sched/AirME-v0")` and its siblings work."""
    for name, domain in DOMAINS.items():
        gymnasium.register(
            id=name, entry_point="marl_sched.envs.api.gymnasium_env:SchedulingEnv", kwargs={"domain": domain}
        )

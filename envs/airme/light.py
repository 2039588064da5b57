"""AirME as a light agent sees it; see marl_sched.light."""

from __future__ import annotations

from marl_sched.envs.airme import numpy_view
from marl_sched.envs.airme.features import pressing
from marl_sched.envs.airme.local_state import AirmeLocalState
from marl_sched.envs.airme.messages import Frame, decode
from marl_sched.light import LightDomain


def local_state(frame: bytes, agent: int) -> AirmeLocalState:
    """A crew's empty local state, observed in NumPy."""
    return AirmeLocalState(decode(frame, Frame), agent, numpy_view.observe)


AIRME = LightDomain(
    name="airme",
    agent_prefix="crew",
    local_state=local_state,
    schedulers="marl_sched.agents.airme.light_rules:RULES",
    pressing=pressing,
)

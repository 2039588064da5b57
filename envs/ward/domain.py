"""The delivery ward as the rooms see it."""

from __future__ import annotations

from marl_sched.domain import Domain
from marl_sched.envs.ward import render
from marl_sched.envs.ward.dynamics import OBJECTIVES
from marl_sched.envs.ward.instance import SCALES, WardInstance, decode, generate, load
from marl_sched.envs.ward.simulator import DEFAULT_HORIZON, WardSimulator
from marl_sched.envs.ward.views import VIEWS
from marl_sched.plugins import lazy

WARD = Domain(
    name="ward",
    title="nurses admit women in labour to the beds of a delivery ward and care for them",
    scales=SCALES,
    objectives=OBJECTIVES,
    views=VIEWS,
    agent_prefix="nurse",
    generate=generate,
    load=load,
    decode=decode,
    instance_type=WardInstance,
    simulator=WardSimulator,
    central=lazy("marl_sched.envs.ward.central:CENTRAL"),
    render={"ansi": render.board, "rgb_array": render.timeline},
    render_options={"rgb_array": {"record_timeline": True}},
    default_horizon=DEFAULT_HORIZON,
    unit="hours",
    better="lower",
    telemetry=lazy("marl_sched.envs.ward.telemetry:TELEMETRY"),
    reference="first-come",
    schedulers="marl_sched.agents.ward.schedulers:RULES",
    legend=render.LEGEND,
    band=("bed", render.CELL),
)

"""AirME as the rooms see it."""

from __future__ import annotations

from marl_sched.domain import Domain
from marl_sched.domain_parts import Demo
from marl_sched.envs.airme import render
from marl_sched.envs.airme.features import pressing
from marl_sched.envs.airme.instance import SCALES, AirmeInstance, decode, generate, load
from marl_sched.envs.airme.simulator import DEFAULT_HORIZON, AirmeSimulator
from marl_sched.envs.airme.state import OBJECTIVES
from marl_sched.envs.airme.views import VIEWS
from marl_sched.plugins import lazy
from marl_sched.privileged import PrivilegedInfo

AIRME = Domain(
    name="airme",
    title="maintenance crews serve a fleet of aircraft whose parts fail by chance",
    scales=SCALES,
    objectives=OBJECTIVES,
    views=VIEWS,
    agent_prefix="crew",
    generate=generate,
    load=load,
    decode=decode,
    instance_type=AirmeInstance,
    simulator=AirmeSimulator,
    central=lazy("marl_sched.envs.airme.central:CENTRAL"),
    render={"ansi": render.fleet_board, "rgb_array": render.timeline},
    render_options={"rgb_array": {"record_timeline": True}},
    default_horizon=DEFAULT_HORIZON,
    telemetry=lazy("marl_sched.envs.airme.telemetry:TELEMETRY"),
    reference="corrective-published",  # section 6.5.2
    schedulers="marl_sched.agents.airme.schedulers:RULES",
    benchmarks=lazy("marl_sched.agents.airme.bench:benchmarks"),
    hidden_info=PrivilegedInfo.FAILURE_MODEL,
    bound="marl_sched.agents.airme.bound.relaxation",
    bound_info=PrivilegedInfo.FAILURE_MODEL | PrivilegedInfo.TIME_LEFT,
    demo=Demo(
        scale="small",
        objective="profit",
        policy="airme-local-profit",
        local_rules=("condition", "preventive-first"),
        central_rules=("corrective", "condition", "model-based", "preventive-first"),
    ),
    pressing=pressing,
    episode_figure=lazy("marl_sched.envs.airme.timeline_figure:episode_figure"),
    advice=lazy("marl_sched.envs.airme.advice:ADVICE"),
    sheet=lazy("marl_sched.envs.airme.sheet:FLEET"),
    records=lazy("marl_sched.envs.airme.fitting:RECORDS"),
)

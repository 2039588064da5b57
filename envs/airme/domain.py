"""AirME as the rooms see it."""

from __future__ import annotations

from marl_sched.domain import Domain
from marl_sched.envs.airme import render
from marl_sched.envs.airme.central import HourlyDecisions
from marl_sched.envs.airme.dynamics import OBJECTIVES
from marl_sched.envs.airme.instance import SCALES, AirmeInstance, decode, generate, load
from marl_sched.envs.airme.simulator import DEFAULT_HORIZON, AirmeSimulator
from marl_sched.envs.airme.telemetry import AirmeTelemetry
from marl_sched.envs.airme.views import VIEWS

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
    central=HourlyDecisions(),
    render={"ansi": render.fleet_board, "rgb_array": render.timeline},
    render_options={"rgb_array": {"record_timeline": True}},
    default_horizon=DEFAULT_HORIZON,
    telemetry=AirmeTelemetry(),
    reference="corrective-published",  # section 6.5.2
    cli_options={"hours": "horizon", "failure": "failure", "scheme": "scheme"},
    legend=render.LEGEND,
    band=("plane", render.CELL),
)

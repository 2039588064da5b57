"""The domain as marl_sched sees it: without telemetry, and with it."""

from __future__ import annotations

from dataclasses import replace

from couriers.graph import VIEWS
from couriers.instance import SCALES, CouriersInstance, decode, generate, load
from couriers.render import BAND, BUSY, IDLE
from couriers.simulator import DEFAULT_HORIZON, OBJECTIVES, CouriersSimulator
from marl_sched.domain import Domain
from marl_sched.plugins import lazy

COURIERS = Domain(
    name="couriers",
    title="couriers serve jobs that arrive day by day and may be cancelled",
    scales=SCALES,
    objectives=OBJECTIVES,
    views=VIEWS,
    agent_prefix="courier",
    generate=generate,
    load=load,
    decode=decode,
    instance_type=CouriersInstance,
    simulator=CouriersSimulator,
    central=lazy("couriers.central:CENTRAL"),
    render={"ansi": lazy("couriers.render:board"), "rgb_array": lazy("couriers.render:timeline")},
    default_horizon=DEFAULT_HORIZON,
    unit="days",
    better="lower",
    reference="idle",
    schedulers="couriers.schedulers:SCHEDULERS",
    legend={"busy": BUSY, "idle": IDLE},
    band=("courier", BAND),
)

DEPLOYABLE = replace(COURIERS, name="couriers-deployable", telemetry=lazy("couriers.telemetry:TELEMETRY"))

"""MuRSE as the rooms see it."""

from __future__ import annotations

from marl_sched.domain import Domain
from marl_sched.domain_parts import Demo
from marl_sched.envs.murse.formats import instance_files, load
from marl_sched.envs.murse.generate import SCALES, generate
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.reading import decode
from marl_sched.envs.murse.rules import OBJECTIVES
from marl_sched.envs.murse.simulator import DEFAULT_HORIZON, MurseSimulator
from marl_sched.envs.murse.views import VIEWS
from marl_sched.plugins import lazy

MURSE = Domain(
    name="murse",
    title="robots and humans who learn share tasks under deadlines, waits and safety distances",
    scales=SCALES,
    objectives=OBJECTIVES,
    views=VIEWS,
    agent_prefix="agent",
    generate=generate,
    load=load,
    decode=decode,
    instance_type=MurseInstance,
    simulator=MurseSimulator,
    central=lazy("marl_sched.envs.murse.central:CENTRAL"),
    render={
        "ansi": lazy("marl_sched.envs.murse.render:board"),
        "rgb_array": lazy("marl_sched.envs.murse.render:gantt"),
    },
    default_horizon=DEFAULT_HORIZON,
    unit="rounds",
    better="lower",
    headline=("feasible", "makespan_feasible"),
    objective_words={
        "makespan": "makespan, infeasible rounds at their worst case",
        "weighted": "weighted completion time, infeasible rounds at their worst case",
    },
    longest=lambda instance: instance.n_rounds,
    schedulers="marl_sched.agents.murse.schedulers:RULES",
    best_of=lazy("marl_sched.agents.murse.sampling:BestOfSamples"),
    feasible=lazy("marl_sched.agents.murse.schedulers:IS_FEASIBLE"),
    benchmarks=lazy("marl_sched.agents.murse.bench:benchmarks"),
    generate_accepted=generate,
    impossibilities=MurseInstance.impossibilities,
    instance_files=instance_files,
    episode_figure=lazy("marl_sched.envs.murse.render:episode_figure"),
    frames=lazy("marl_sched.envs.murse.animation:round_frames"),
    telemetry=lazy("marl_sched.envs.murse.telemetry:TELEMETRY"),
    save_schedules=lazy("marl_sched.envs.murse.schedule:save_schedules"),
    schedules=lazy("marl_sched.envs.murse.schedule_files:SCHEDULES"),
    solver_bound=lazy("marl_sched.agents.murse.schedulers:SOLVER_BOUND"),
    advice=lazy("marl_sched.envs.murse.advice:ADVICE"),
    sheet=lazy("marl_sched.envs.murse.sheet:TASKS"),
    demo=Demo(
        scale="small",
        objective="makespan",
        policy="murse-local-makespan",
        options={"mode": "online", "durations": "stochastic"},
        local_rules=("lst-local",),
        central_rules=("lst", "lst-robust-rollout"),
        seed=2,  # the first on which agents with local views meet all deadlines; the comparison tells how often they do
        episodes=1,
    ),
)

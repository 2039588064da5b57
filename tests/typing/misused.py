"""Misuses of the environments' options. mypy must refuse exactly the lines that say so; no test runs this file."""

from __future__ import annotations

from typing import assert_type

from marl_sched import airme_v0, murse_v0
from marl_sched.envs.airme.views import LocalView
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.parallel import SchedulingParallel

airme_v0.env(scael="small")  # refused
airme_v0.env(scale="smal")  # refused
airme_v0.env(view="lokal")  # refused
airme_v0.env(view={"kind": "local", "raech": 1})  # refused
airme_v0.env(view={"reach": 1})  # refused
airme_v0.raw_env(horizon="long")  # refused
airme_v0.parallel_env(split="exam")  # refused
airme_v0.parallel_env(mask="nowhere")  # refused
murse_v0.env(mode="offline")  # refused
murse_v0.env(failure="hazard")  # refused
murse_v0.parallel_env(view=LocalView())  # refused

airme_v0.env(scale="small", view={"kind": "local", "reach": 1, "comm": 0}, seed=None, split="test", flat=True)
airme_v0.raw_env(view=LocalView(reach=2), stop_share=0.8, horizon=24)
murse_v0.env(view={"kind": "local", "sensing": 2.5}, mode="online", durations="stochastic", pad_agents=True)
assert_type(airme_v0.raw_env(), SchedulingAEC)
assert_type(murse_v0.parallel_env(), SchedulingParallel)

"""How fast a domain's simulator, its environment APIs and the policy are on this machine, on one thread.

A figure is the best of several repeats in CPU time of the one thread, so that what else runs on the machine counts
as little as it can. Nothing is compiled, drawn or decided within a measurement that is not what it is of.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from marl_sched.agents.benchmark import own_benchmarks
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import Domain
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK
from marl_sched.simulation import TurnSimulator

SCHEMA = 1
BATCH = 1024
_AEC_TURNS = 5_000
_TORCHRL_STEPS = 100
_POLICY_DECISIONS = 200
_MEANINGS = {
    "aec_turns_per_s": "AEC turns with observations, small instance, random legal choices: last() and step()",
    "torchrl_decisions_per_s": "decisions of a TorchRL batch of small instances with full observations, "
    "random legal choices: rand_action() and step_and_maybe_reset()",
    "policy_ms": "one decision of the default HetGAT policy at batch size 1 with a full view, observing included",
}


def bench(domain: Domain, *, repeats: int = 5, batch: int | None = None) -> dict[str, Any]:
    """All figures of a domain, ready for JSON; `meaning` says what each of them is of. Uses one thread.

    `batch`: envs of what is measured in batches, None: BATCH; fewer for a simulator that is not compiled.
    """
    batch = BATCH if batch is None else batch
    if repeats < 1:
        raise InvalidOptionError(f"repeats: expected an integer >= 1, got {repeats}")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        own = own_benchmarks(domain, batch)
        figures = {
            **{name: each.per_second * _best(repeats, each.prepare, each.play) for name, each in own.items()},
            "aec_turns_per_s": aec_turns_per_second(domain, repeats),
            "torchrl_decisions_per_s": torchrl_decisions_per_second(domain, repeats, batch),
            "policy_ms": {scale: policy_milliseconds(domain, scale, repeats) for scale in _scales(domain)},
        }
    finally:
        torch.set_num_threads(threads)
    head = {
        "schema": SCHEMA,
        "env": domain.name,
        "threads": 1,
        "repeats": repeats,
        "batch": batch,
        "statistic": "best of repeats, CPU time",
    }
    return {**head, **figures, "meaning": {**{name: each.meaning for name, each in own.items()}, **_MEANINGS}}


def _scales(domain: Domain) -> list[str]:
    """What is measured: the scales small and large, or of a domain without them its first and its last."""
    names = list(domain.scales)
    return ["small", "large"] if {"small", "large"} <= set(names) else [names[0], names[-1]]


def aec_turns_per_second(domain: Domain, repeats: int) -> float:
    """Turns of the AEC environment per second, each with an observation and a random legal choice."""
    env = SchedulingAEC(domain, scale=_scales(domain)[0])
    uniforms = np.random.default_rng(0).random(_AEC_TURNS)

    def play() -> None:
        for uniform in uniforms:
            observation, _, terminated, truncated, _ = env.last()
            if terminated or truncated:
                env.reset()
                continue
            legal = np.flatnonzero(observation[ACTION_MASK])
            env.step(int(legal[int(uniform * len(legal))]))

    return _AEC_TURNS / _best(repeats, lambda: env.reset(seed=0), play)


def torchrl_decisions_per_second(domain: Domain, repeats: int, batch: int) -> float:
    """Decisions per second of a TorchRL batch that is stepped without storing a rollout."""
    env = SchedulingTorchRL(domain, batch_size=batch, scale=_scales(domain)[0])
    state = {"now": env.reset()}

    def play() -> None:
        for _ in range(_TORCHRL_STEPS):
            _, state["now"] = env.step_and_maybe_reset(env.rand_action(state["now"]))

    return batch * _TORCHRL_STEPS / _best(repeats, lambda: None, play)


def policy_milliseconds(domain: Domain, scale: str, repeats: int) -> float:
    """Milliseconds of one decision of the default network, fresh, as a policy at batch size 1."""
    simulator: TurnSimulator = domain.simulator(domain.instances(scale, 1, 0), pad=scale)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = NetworkPolicy(HetGATNetwork(simulator.graph), domain=domain.name)

    def play() -> None:
        for _ in range(_POLICY_DECISIONS):
            simulator.step(policy.decide(simulator))

    return 1e3 / _POLICY_DECISIONS * _best(repeats, simulator.reset, play)


def _best(repeats: int, prepare: Callable[[], Any], play: Callable[[], Any]) -> float:
    """The least CPU seconds that `play` took, after one run that does not count: it compiles and fills caches."""
    seconds = []
    for _ in range(repeats + 1):
        prepare()
        started = time.thread_time()
        play()
        seconds.append(time.thread_time() - started)
    return min(seconds[1:])

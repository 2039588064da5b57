"""Runs in this process, and the run without messages that they must equal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.inproc import Bus, Threads
from marl_sched.comms.options import WorldOptions
from marl_sched.domain import get_domain


def played_in_process(options: WorldOptions, policies: list[str]) -> dict[str, Any]:
    """What the simulator and the schedulers alone make of a run: decisions, rewards and M1 as in the report."""
    simulator, domain = options.simulator(), options.domain
    schedulers = [create_scheduler(policy, domain) for policy in policies]
    for scheduler in schedulers:
        scheduler.start(simulator, np.ones(1, np.bool_))
    decisions, rewards, time_unit = [], [], options.telemetry().time_unit
    while not simulator.over[0]:
        time, agent = int(simulator.time[0]), int(simulator.acting[0])
        action = schedulers[agent].decide(simulator)
        simulator.step(action)
        outcome = "conflict" if simulator.conflict[0] else "decided"
        name = domain.agent_name(agent)
        decisions.append({time_unit: time, "agent": name, "action": int(action[0]), "outcome": outcome})
        rewards.append(float(simulator.reward[0]))
    m1 = float(simulator.objectives()[options.problem.objective][0])
    return {"decisions": decisions, "rewards": rewards, "M1": m1}


@pytest.fixture
def save_policy(tmp_path: Path) -> Callable[[int], str]:
    """Writes an untrained HetGAT policy with a seed of its own; its path."""

    def save(seed: int) -> str:
        torch = pytest.importorskip("torch")
        from marl_sched.agents.networks.hetgat.network import HetGATNetwork
        from marl_sched.agents.policies.cards import PolicyCard
        from marl_sched.agents.policies.checkpoint import save_network

        graph = get_domain("airme").simulator(get_domain("airme").instances("small", 1, 0), pad="small").graph
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = HetGATNetwork(graph, width=4, heads=2, layers=2)
        card = PolicyCard(
            domain="airme", objective="profit", view={"kind": "local"}, graph=graph, sizes=network.sizes,
            command="none", git_hash="none", seed=seed, scores={},
        )  # fmt: skip
        path = tmp_path / f"policy-{seed}.safetensors"
        save_network(path, network, card)
        return str(path)

    return save


@pytest.fixture
def in_process() -> Callable[[WorldOptions, list[str]], dict[str, Any]]:
    return played_in_process


@pytest.fixture
def make_run() -> Callable[..., Threads]:
    return Threads


@pytest.fixture
def make_bus() -> Callable[..., Bus]:
    return Bus

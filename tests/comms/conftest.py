"""A network in memory, and the in-process run that a distributed one must equal."""

from __future__ import annotations

import fnmatch
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.agent import Agent
from marl_sched.comms.options import AgentOptions, WorldOptions
from marl_sched.comms.session import Event
from marl_sched.comms.world import World


class Bus:
    """Connects nodes as Zenoh would: keys with wildcards, liveliness, queries. `deliver` may lose or repeat.

    `deliver(key, payload)` says how many copies of a message arrive; by default one.
    """

    def __init__(self, deliver: Callable[[str, bytes], int] = lambda key, payload: 1) -> None:
        self.deliver = deliver
        self.nodes: list[Node] = []
        self.tokens: set[str] = set()
        self.log: list[tuple[str, bytes]] = []
        self.lock = threading.RLock()

    def node(self) -> Node:
        with self.lock:
            self.nodes.append(Node(self))
            return self.nodes[-1]

    def alive(self, key: str, kind: Any) -> None:
        with self.lock:
            (self.tokens.add if kind == "alive" else self.tokens.discard)(key)
            for node in self.nodes:
                if any(fnmatch.fnmatch(key, watched) for watched in node.watched):
                    node.inbox.put(Event(kind, key))


class Node:
    """A Transport on a Bus."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.inbox = bus, queue.SimpleQueue()
        self.subscribed: set[str] = set()
        self.watched: set[str] = set()
        self.served: set[str] = set()
        self.on_put: Callable[[str, bytes], None] | None = None  # may raise, to play a process that dies

    def put(self, key: str, payload: bytes, *, reliable: bool = False) -> None:
        if self.on_put is not None:
            self.on_put(key, payload)
        with self.bus.lock:
            self.bus.log.append((key, payload))
            for _ in range(self.bus.deliver(key, payload)):
                for node in self.bus.nodes:
                    if node is not self and any(fnmatch.fnmatch(key, pattern) for pattern in node.subscribed):
                        node.inbox.put(Event("message", key, payload))

    def receive(self, timeout: float) -> Event | None:
        try:
            return self.inbox.get(timeout=max(timeout, 0.0))
        except queue.Empty:
            return None

    def subscribe(self, key: str) -> None:
        self.subscribed.add(key)

    def watch(self, key: str) -> None:
        with self.bus.lock:
            self.watched.add(key)
            for token in self.bus.tokens:
                if fnmatch.fnmatch(token, key):
                    self.inbox.put(Event("alive", token))

    def announce(self, key: str) -> None:
        self.bus.alive(key, "alive")

    def withdraw(self, key: str) -> None:
        self.bus.alive(key, "gone")

    def serve(self, key: str) -> None:
        self.served.add(key)

    def reply(self, event: Event, payload: bytes) -> None:
        event.query.put(payload)

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:
        answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        servers = [node for node in self.bus.nodes if key in node.served]
        if not servers:
            return None
        servers[0].inbox.put(Event("query", key, payload, answers))
        try:
            return answers.get(timeout=timeout)
        except queue.Empty:
            return None


class Run:
    """A world and its agents as threads of this process on a Bus."""

    def __init__(self, options: WorldOptions, policies: list[str], bus: Bus | None = None) -> None:
        self.bus = bus or Bus()
        self.world = World(options, self.bus.node())
        self.nodes = [self.bus.node() for _ in policies]
        self.agents: list[Agent | None] = [None] * len(policies)
        self.errors: list[BaseException] = []
        self.policies = policies

    def play(self) -> dict[str, Any]:
        threads = [threading.Thread(target=self.agent, args=(i,), daemon=True) for i in range(len(self.policies))]
        for thread in threads:
            thread.start()
        report = self.world.run()
        for thread in threads:
            thread.join(timeout=10)
        return report

    def agent(self, index: int) -> None:
        try:
            options = AgentOptions(agent=index, policy=self.policies[index], join_timeout=20.0)
            self.agents[index] = Agent(options, self.nodes[index])
            self.agents[index].run()
            for token in [token for token in self.bus.tokens if token.startswith(f"crew/{index}/")]:
                self.bus.alive(token, "gone")  # as closing a session does
        except BaseException as error:  # a thread has nobody to raise to; tests look here
            self.errors.append(error)


def played_in_process(options: WorldOptions, policies: list[str]) -> dict[str, Any]:
    """What the simulator and the schedulers alone make of a run: decisions, rewards and M1 as in the report."""
    simulator, domain = options.simulator(), options.domain()
    schedulers = [create_scheduler(policy, domain) for policy in policies]
    decisions, rewards = [], []
    while not simulator.over[0]:
        hour, agent = int(simulator.time[0]), int(simulator.acting[0])
        target = schedulers[agent].decide(simulator)
        simulator.step(target)
        outcome = "conflict" if simulator.conflict[0] else "decided"
        decisions.append({"hour": hour, "agent": f"crew_{agent}", "plane": int(target[0]), "outcome": outcome})
        rewards.append(float(simulator.reward[0]))
    m1 = float(np.float64(simulator.objectives()["profit"][0]))
    return {"decisions": decisions, "rewards": rewards, "M1": m1}


@pytest.fixture
def save_policy(tmp_path: Path) -> Callable[[int], str]:
    """Writes an untrained HetGAT policy with a seed of its own; its path."""

    def save(seed: int) -> str:
        torch = pytest.importorskip("torch")
        from marl_sched.agents.networks.hetgat.network import HetGATNetwork
        from marl_sched.agents.policies.cards import PolicyCard
        from marl_sched.agents.policies.checkpoint import save_network

        graph = WorldOptions(seed=0).simulator().graph
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
def make_run() -> Callable[..., Run]:
    return Run


@pytest.fixture
def make_bus() -> Callable[..., Bus]:
    return Bus

"""A run of any length takes the memory of a short one: world and agent with nothing to simulate, on a bus."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

from marl_sched.comms.decision_log import FileLog, Header
from marl_sched.comms.inproc import Bus, Node
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import Commit, PlantSummary
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.agent_protocol import AgentProtocol
from marl_sched.comms.protocol.rules import AgentRules
from marl_sched.comms.world import World
from marl_sched.problem import Problem

MOST_BYTES = 100_000  # that a thousand further ticks may take; a commit that is kept would take more


class EmptyPlant:
    """One agent and one channel, which changes at every tick; nothing else happens."""

    simulated, n_agents, frame, channels = True, 1, b"", (("state/0",),)

    def __init__(self) -> None:
        self.tick = 0

    def state(self) -> ev.PlantAdvanced:
        return ev.PlantAdvanced(self.tick, (ev.Request(0, 0.5),), {"state/0": b"%d" % self.tick})

    def apply(self, choices: Sequence[ev.Choice]) -> list[Commit]:
        self.tick += 1
        told = {"reward": 0.0, "share": 1.0, "tick": self.tick}
        return [Commit(agent=c.agent, action=c.action, outcome=c.outcome, **told) for c in choices]

    def objectives(self) -> dict[str, float]:
        return {"profit": 0.0}

    def summary(self) -> PlantSummary:
        return PlantSummary(time=self.tick, progress=0, objectives=self.objectives(), series={}, agent_figures={})


class Echo:
    """An agent that always chooses 1."""

    def __init__(self, node: Node, now: float) -> None:
        rules = AgentRules(join=1e9, silence=1e9)
        self.node = node
        self.protocol = AgentProtocol(rules, run="run", agent=0, policy="echo", identity="a", mind=self, now=now)
        self.handle(ev.Reopened(), now)

    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        return "crew", ("state/0",)

    def learn(self, channel: str, payload: bytes) -> None:
        pass

    def forget(self) -> bool:
        return False

    def pump(self, now: float) -> None:
        """Take in everything that has come, and the time."""
        while (event := self.node.receive(0)) is not None:
            self.handle(event, now)
        self.handle(ev.Wake(), now)

    def handle(self, event: ev.Event, now: float) -> None:
        for effect in self.protocol.handle(event, now):
            match effect:
                case ev.Put(key, message):
                    self.node.put(key, wire.encode(message))
                case ev.Ask(question, key, asked):
                    self.node.ask(question, key, b"" if asked is None else wire.encode(asked))
                case ev.Choose(turn):
                    self.handle(ev.Chosen(turn.sequence, 1), now)
                case ev.Announce(key):
                    self.node.announce(key)
                case ev.Subscribe(key, quiet):
                    self.node.subscribe(key, quiet=quiet)
                case ev.Watch(key):
                    self.node.watch(key)


class Run:
    """The world and its agent, a tick of simulated time every millisecond of a clock of its own."""

    def __init__(self, path: Path) -> None:
        self.now, bus = 0.0, Bus()
        options = WorldOptions(problem=Problem("airme", count=1))
        log = FileLog(path, Header.of(options))
        self.world = World(options, bus.node(), plant=EmptyPlant(), commits=log, clock=lambda: self.now)
        self.world._open()
        self.agent = Echo(bus.node(), self.now)

    def play(self, ticks: int) -> int:
        """Play so many ticks; the bytes that Python holds then, if they are traced."""
        end = self.world.plant.tick + ticks
        while self.world.plant.tick < end:
            self.now += 0.001
            self.agent.pump(self.now)
            self.world.transport.inject(ev.Wake())
            while self.world.transport.inbox._ready.qsize():
                self.world._turn_once()
        gc.collect()
        return tracemalloc.get_traced_memory()[0]


def test_memory_of_a_run_does_not_grow_with_its_length(tmp_path):
    run = Run(tmp_path / "run.jsonl")
    run.play(200)
    tracemalloc.start()
    try:
        before = run.play(200)
        after = run.play(1000)
    finally:
        tracemalloc.stop()
    assert after - before < MOST_BYTES
    assert run.agent.protocol.counts["decisions"] >= 1400

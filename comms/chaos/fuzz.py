"""Keys and payloads that nobody would write, against the pure protocol of the world and of an agent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from marl_sched.comms.membership.slots import FENCES, TOKENS
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.agent_protocol import AgentProtocol
from marl_sched.comms.protocol.rules import AgentRules, WorldRules
from marl_sched.comms.protocol.world_protocol import WorldProtocol
from marl_sched.errors import InvalidMessageError

RUN, EPOCH, PREFIX, AGENTS = "run", "epoch", "bot", 3
STEP = 0.001  # seconds between two events
VALUES: Sequence[Any] = (
    0, 1, -1, 2, AGENTS, 10**6, 2**61, 2**62, 2**63, 2**64 - 1, 0.5, float("nan"), float("inf"), True, None, "", "e",
    RUN, EPOCH, "x" * 65, "x" * 5000, b"", b"\xff" * 40, [], [1], {}, {"a": 1}, "given_up", "over", "\U0001f600", "\0",
)  # fmt: skip


class Fuzzer:
    """Makes events by mutating what is really said; the same seed makes the same ones."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        us: dict[str, Any] = {"run": RUN, "epoch": EPOCH}
        news = wire.News(**us, channel="state/1", sequence=1, payload=b"s")
        me: dict[str, Any] = {"agent": 1, "incarnation": "a"}
        self._messages: list[wire.Message] = [
            wire.Hello(**us, **me, policy="p"),
            wire.Beat(**us, **me, tick=1, counts={"heard": 1}),
            wire.Goodbye(**us, **me, counts={}),
            wire.Decision(**us, **me, tick=0, sequence=1, action=1),
            wire.SnapshotRequest(**us, agent=1),
            wire.Clock(**us, tick=1, phase="running"),
            wire.Turn(**us, **me, tick=0, sequence=1, noise=0.5, needs={"state/1": 1}),
            wire.Welcome(**us, **me),
            wire.Fenced(**us, **me, why="unknown", reason="r"),
            wire.Refused(**us, reason="r"),
            wire.Frame(**us, env="toy", agents=AGENTS, heartbeat=0.5, problem=b"f"),
            wire.Snapshot(**us, tick=1, phase="running", channels=[news]),
            news,
        ]

    def choose(self, among: Sequence[Any]) -> Any:
        """One of them."""
        return among[int(self._random.integers(len(among)))]

    def payload(self) -> bytes:
        """Bytes: of a message, of one that was changed, or any."""
        how = self._random.random()
        if how < 0.1:
            return self._random.bytes(int(self._random.integers(0, 200)))
        said = self.choose(self._messages)
        if how < 0.3:
            return wire.encode(said)
        fields = msgspec.msgpack.decode(wire.encode(said))
        if how < 0.7:
            for _ in range(int(self._random.integers(1, 3))):
                name = self.choose([*fields, "type", "extra"])
                if self._random.random() < 0.2:
                    fields.pop(name, None)
                else:
                    fields[name] = self.choose(VALUES)
            return msgspec.msgpack.encode(fields)
        raw = bytearray(wire.encode(said))
        for _ in range(int(self._random.integers(1, 4))):
            raw[int(self._random.integers(len(raw)))] = int(self._random.integers(256))
        return bytes(raw[: int(self._random.integers(len(raw) + 1))]) if how > 0.9 else bytes(raw)

    def key(self) -> str:
        """A key of the run, or anything."""
        agent = self.choose(["0", "1", "2", "3", "-1", "999999", "1000000", "9" * 5000, "x", ""])
        leaf = self.choose(["hello", "decision", "turn", "alive/a", "alive/b", "alive/", "alive/" + "z" * 60, "memory"])
        return str(
            self.choose(
                [
                    f"{PREFIX}/{agent}/{leaf}",
                    f"{PREFIX}/1/{leaf}",
                    keys.CLOCK,
                    keys.FRAME,
                    keys.snapshot(agent),
                    "state/1",
                    "".join(map(chr, self._random.integers(1, 0xD7FF, 12))),
                ]
            )
        )

    def event(self) -> ev.Event:
        """Something that the network could bring."""
        kind = self._random.random()
        if kind < 0.7:
            return ev.Received(self.key(), self.payload())
        if kind < 0.8:
            return ev.TokenAppeared(self.key())
        if kind < 0.85:
            return ev.TokenVanished(self.key())
        return ev.Queried(self.key(), self.payload(), 1) if kind < 0.95 else ev.Answered(1, self.payload())


class Mind:
    """An agent's mind that takes in states of one byte."""

    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        """See Mind.meet of the agent's protocol."""
        return PREFIX, ("state/1",)

    def learn(self, channel: str, payload: bytes) -> None:
        """See Mind.learn of the agent's protocol."""
        if len(payload) != 1:
            raise InvalidMessageError("a state has one byte")

    def forget(self) -> bool:
        """See Mind.forget of the agent's protocol."""
        return False


class WorldUnderFuzz:
    """A world of three agents, each with a channel, whose plant asks them in turn for ever."""

    def __init__(self) -> None:
        channels = [(f"state/{i}",) for i in range(AGENTS)]
        self.protocol = WorldProtocol(
            WorldRules(ready=1e9, standstill=1e9),
            run=RUN,
            epoch=EPOCH,
            env="toy",
            prefix=PREFIX,
            frame=b"f",
            channels=channels,
            now=0.0,
        )
        self.turn, self.asked = 0, None  # type: int, wire.Turn | None
        self._carry_out(self.protocol.handle(self._state(), 0.0), 0.0)

    def _state(self) -> ev.PlantAdvanced:
        changed = {f"state/{i}": b"s" for i in range(AGENTS)}
        return ev.PlantAdvanced(self.turn // AGENTS, (ev.Request(self.turn % AGENTS, 0.5),), changed)

    def take(self, event: ev.Event, now: float) -> None:
        """An event; ValueError if the world then does what it must not."""
        self._carry_out(self.protocol.handle(event, now), now)
        if self.protocol.ended is not None:
            raise ValueError(f"{event}: the world ended: {self.protocol.ended}")
        for slot in self.protocol.members.slots:
            if len(slot.tokens) > TOKENS or len(slot.fenced) > FENCES:
                raise ValueError(f"{event}: a slot holds more than its bound")

    def be_honest(self, number: int, now: float) -> None:
        """Let agents join that are not there, and the one that has a turn decide, so that there is harm to do."""
        us: dict[str, Any] = {"run": RUN, "epoch": EPOCH}
        for agent, slot in enumerate(self.protocol.members.slots):
            if not slot.present:
                hello = wire.Hello(**us, agent=agent, incarnation=f"h-{number}", policy="p")
                self.take(ev.TokenAppeared(f"{PREFIX}/{agent}/alive/{hello.incarnation}"), now)
                self.take(ev.Received(f"{PREFIX}/{agent}/hello", wire.encode(hello)), now)
        if self.asked is not None:
            turn, names = self.asked, ("tick", "agent", "incarnation", "sequence")
            decision = wire.Decision(**us, **{name: getattr(turn, name) for name in names}, action=1)
            self.take(ev.Received(f"{PREFIX}/{turn.agent}/decision", wire.encode(decision)), now)

    def _carry_out(self, effects: list[ev.Effect], now: float) -> None:
        for effect in effects:
            if isinstance(effect, ev.Put | ev.Reply):
                wire.encode(effect.message)
                if isinstance(effect.message, wire.Turn):
                    self.asked = effect.message
            elif isinstance(effect, ev.Apply):
                if [choice.agent for choice in effect.choices] != [self.turn % AGENTS]:
                    raise ValueError(f"{effect}: agent {self.turn % AGENTS} was asked")
                self.turn += 1
                self._carry_out(self.protocol.handle(self._state(), now), now)


def fuzz(count: int, seed: int = 0) -> Counter[str]:
    """Give `count` events to a world and as many to an agent; what was counted. ValueError for a broken invariant."""
    fuzzer, world, counts, now = Fuzzer(seed), WorldUnderFuzz(), Counter[str](), 0.0
    agent = _agent(now)
    for number in range(count):
        now += STEP
        if number % 10 == 0:
            world.be_honest(number, now)
        world.take(fuzzer.event(), now)
        for effect in agent.handle(fuzzer.event(), now):
            if isinstance(effect, ev.Put):
                wire.encode(effect.message)
        counts["events"] += 2
        if agent.ended is not None:
            counts["agents ended"] += 1
            agent = _agent(now)
    counts["turns"] = world.turn
    return counts


def _agent(now: float) -> AgentProtocol:
    """An agent that has just asked for the frame, and takes question 1 for its own."""
    rules = AgentRules(join=1e9)
    agent = AgentProtocol(rules, run=RUN, agent=1, policy="p", identity="a", mind=Mind(), now=now)
    agent.handle(ev.Reopened(), now)
    return agent

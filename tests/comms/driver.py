"""A world protocol without a problem behind it, driven step by step at times that the test gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.rules import WorldRules
from marl_sched.comms.protocol.world_protocol import WorldProtocol

RUN, EPOCH = "run", "e1"
US = {"run": RUN, "epoch": EPOCH}


class WorldDriver:
    """A world protocol of `n` agents called `bot_<i>`, each with one channel `state/<i>`, and a plant of turns.

    The plant asks the agents in turn, each once per tick. `at(time, event)` gives the effects. Applied choices are in
    `applied`; the plant's next state is given to the protocol at once, and its effects are appended.
    """

    def __init__(self, n: int = 2, *, ticks: int = 1000, together: bool = False, **rules: Any) -> None:
        self.n, self.ticks, self.together = n, ticks, together
        self.rules = WorldRules(**rules)
        self.protocol = WorldProtocol(
            self.rules, run=RUN, epoch=EPOCH, env="toy", prefix="bot", frame=b"f",
            channels=[(f"state/{i}",) for i in range(n)], now=0.0,
        )  # fmt: skip
        self.applied: list[ev.Choice] = []
        self.tick, self.turn = 0, 0
        self.after_sleep(0.0, self.state())

    def state(self) -> ev.PlantAdvanced:
        changed = {f"state/{i}": b"%d.%d" % (self.tick, self.turn) for i in range(self.n)}
        agents = range(self.n) if self.together else [self.turn]
        requests = tuple(ev.Request(i, 0.25) for i in agents) if self.tick < self.ticks else ()
        return ev.PlantAdvanced(self.tick, requests, changed, over=self.tick >= self.ticks)

    def at(self, now: float, event: ev.Event | None = None) -> list[ev.Effect]:
        """The effects of an event (by default of time alone); until then the protocol is woken whenever it wants."""
        while self.protocol.wake_at < now:
            self.after_sleep(self.protocol.wake_at)
        return self.after_sleep(now, event)

    def after_sleep(self, now: float, event: ev.Event | None = None) -> list[ev.Effect]:
        """The effects of an event, with no wake-up before it."""
        effects = self.protocol.handle(event or ev.Wake(), now)
        for effect in list(effects):
            if isinstance(effect, ev.Apply):
                self.applied += effect.choices
                self.turn += len(effect.choices)
                self.tick, self.turn = (self.tick + 1, 0) if self.turn >= self.n else (self.tick, self.turn)
                effects += self.after_sleep(now, self.state())
        return effects

    def slot(self, agent: int):
        return self.protocol.members.slots[agent]

    # ---- what agents say

    def hello(self, now: float, agent: int, incarnation: str = "a") -> list[ev.Effect]:
        self.at(now, ev.TokenAppeared(f"bot/{agent}/alive/{incarnation}"))
        return self.say(now, agent, wire.Hello(**US, agent=agent, incarnation=incarnation, policy="p"))

    def beat(self, now: float, agent: int, incarnation: str = "a") -> list[ev.Effect]:
        return self.say(now, agent, wire.Beat(**US, agent=agent, incarnation=incarnation, tick=0, counts={"heard": 3}))

    def goodbye(self, now: float, agent: int, incarnation: str = "a") -> list[ev.Effect]:
        return self.say(now, agent, wire.Goodbye(**US, agent=agent, incarnation=incarnation, counts={"heard": 4}))

    def say(self, now: float, agent: int, message: wire.Message, leaf: str = "hello") -> list[ev.Effect]:
        return self.at(now, ev.Received(f"bot/{agent}/{leaf}", wire.encode(message)))

    def decide(self, now: float, turn: wire.Turn, action: int = 1, **changes: Any) -> list[ev.Effect]:
        fields = {
            "tick": turn.tick, "agent": turn.agent, "incarnation": turn.incarnation, "sequence": turn.sequence,
        }  # fmt: skip
        decision = wire.Decision(**{**US, **fields, "action": action, **changes})
        return self.say(now, turn.agent, decision, "decision")

    def gone(self, now: float, agent: int, incarnation: str = "a") -> list[ev.Effect]:
        return self.at(now, ev.TokenVanished(f"bot/{agent}/alive/{incarnation}"))

    def gathered(self, now: float = 1.0) -> list[ev.Effect]:
        """All agents join; the effects of the last hello, with which the run begins."""
        for agent in range(self.n):
            effects = self.hello(now, agent)
        return effects

    def keep_alive(self, now: float, *but: int) -> None:
        for agent in set(range(self.n)) - set(but):
            if self.slot(agent).present:
                self.beat(now, agent, self.slot(agent).incarnation)


def of(effects: Sequence[ev.Effect], kind: type) -> list[Any]:
    """The effects of one kind."""
    return [effect for effect in effects if isinstance(effect, kind)]


def turns(effects: Sequence[ev.Effect]) -> list[wire.Turn]:
    """The turns that were put."""
    return [put.message for put in of(effects, ev.Put) if isinstance(put.message, wire.Turn)]


def said(effects: Sequence[ev.Effect], kind: type) -> list[Any]:
    """The messages of one kind that were put."""
    return [put.message for put in of(effects, ev.Put) if isinstance(put.message, kind)]

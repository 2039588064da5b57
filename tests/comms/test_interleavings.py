"""World and agents over a network that loses, repeats, delays and reorders, in virtual time: what always holds."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.agent_protocol import AgentProtocol
from marl_sched.comms.protocol.rules import AgentRules
from tests.comms.driver import RUN, WorldDriver

N, TICKS, LIMIT = 3, 6, 400.0


class Mind:
    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        return "bot", ()

    def learn(self, channel: str, payload: bytes) -> None:
        """All that is learnt is forgotten."""

    def forget(self) -> bool:
        return False


class Universe:
    """A world, agents and the network between them; `faults` are (time, what, agent)."""

    def __init__(self, seed: int, loss: float, faults: list[tuple[float, str, int]], *, together: bool) -> None:
        self.rng, self.loss, self.now = np.random.default_rng(seed), loss, 0.0
        self.world = WorldDriver(N, ticks=TICKS, together=together, standstill=30.0, grace=3.0, ready=200.0)
        self.world.protocol._channels = [()] * N
        self.names, self.order = itertools.count(), itertools.count()
        self.queue: list[tuple[float, int, Any, ev.Event]] = []
        self.agents: dict[int, AgentProtocol] = {}
        self.frozen: dict[int, float] = {}  # agent -> until when
        self.tokens: dict[int, str] = {}
        self.incarnations_applied: set[tuple[str, int]] = set()
        for agent in range(N):
            self.start(agent)
        for at, what, agent in faults:
            heapq.heappush(self.queue, (at, next(self.order), (what, agent), ev.Wake()))

    def start(self, agent: int) -> None:
        self.drop_token(agent)
        self.agents[agent] = AgentProtocol(
            AgentRules(join=300.0), run=RUN, agent=agent, policy="p", identity=f"x{next(self.names)}", mind=Mind(),
            now=self.now,
        )  # fmt: skip
        self.frozen.pop(agent, None)
        self.give(agent, ev.Reopened())

    def send(self, to: Any, event: ev.Event, *, lossy: bool = True) -> None:
        copies = int(self.rng.choice([0, 1, 2], p=[self.loss, 1 - 1.5 * self.loss, self.loss / 2])) if lossy else 1
        for _ in range(copies):
            delay = float(self.rng.exponential(0.02))
            heapq.heappush(self.queue, (self.now + delay, next(self.order), to, event))

    def drop_token(self, agent: int) -> None:
        if token := self.tokens.pop(agent, ""):
            self.send("world", ev.TokenVanished(token), lossy=False)

    def give(self, agent: int, event: ev.Event) -> None:
        protocol = self.agents.get(agent)
        if protocol is None or self.frozen.get(agent, 0.0) > self.now:
            return
        for effect in protocol.handle(event, self.now):
            match effect:
                case ev.Put(key, message):
                    self.send("world", ev.Received(key, wire.encode(message)))
                case ev.Ask(question, key, message):
                    payload = b"" if message is None else wire.encode(message)
                    self.send("world", ev.Queried(key, payload, agent * 10**6 + question))
                case ev.Choose(turn):
                    self.give(agent, ev.Chosen(turn.sequence, turn.sequence))
                case ev.Announce(key):
                    self.drop_token(agent)
                    self.tokens[agent] = key
                    self.send("world", ev.TokenAppeared(key), lossy=False)
                case ev.Withdraw():
                    self.drop_token(agent)
                case ev.Reopen():
                    self.drop_token(agent)
                    self.send(agent, ev.Reopened(), lossy=False)
                case ev.End():
                    self.drop_token(agent)
                    self.agents.pop(agent, None)

    def give_world(self, event: ev.Event) -> None:
        for effect in self.world.after_sleep(self.now, event):
            match effect:
                case ev.Put(key, message):
                    targets = [int(key.split("/")[1])] if key.startswith("bot/") else range(N)
                    for agent in targets:
                        self.send(agent, ev.Received(key, wire.encode(message)))
                case ev.Reply(query, message):
                    self.send(query // 10**6, ev.Answered(query % 10**6, wire.encode(message)))

    def fault(self, what: str, agent: int) -> None:
        if what == "kill":
            self.drop_token(agent)
            self.agents.pop(agent, None)
        elif what == "restart":
            self.start(agent)
        elif what == "freeze":
            self.frozen[agent] = self.now + 8.0
            self.drop_token(agent)
        elif what == "cut":
            self.drop_token(agent)

    def run(self) -> None:
        while self.world.protocol.ended is None and self.now < LIMIT:
            waits = {agent: p.wake_at for agent, p in self.agents.items()}
            times = {agent: max(at, self.frozen.get(agent, 0.0)) for agent, at in waits.items()}
            nearest = min(times, key=lambda agent: times[agent], default=None)
            due = min(self.world.protocol.wake_at, times[nearest] if nearest is not None else LIMIT)
            if self.queue and self.queue[0][0] <= due:
                at, _, to, event = heapq.heappop(self.queue)
                self.now = max(self.now, at)
                if isinstance(to, tuple):
                    self.fault(*to)
                elif to == "world":
                    self.give_world(event)
                else:
                    self.give(to, event)
                continue
            self.now = max(self.now, due)
            if due == self.world.protocol.wake_at:
                self.give_world(ev.Wake())
            elif nearest is not None:
                self.give(nearest, ev.Wake())


FAULTS = st.lists(
    st.tuples(
        st.floats(0.1, 40.0), st.sampled_from(["kill", "restart", "freeze", "cut"]), st.integers(0, N - 1)
    ),
    max_size=6,
)  # fmt: skip


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32), loss=st.sampled_from([0.0, 0.1, 0.3]), faults=FAULTS, together=st.booleans())
def test_every_turn_is_settled_once_and_the_run_ends(seed, loss, faults, together):
    universe = Universe(seed, loss, faults, together=together)
    universe.run()
    world = universe.world
    assert world.protocol.ended is not None, f"still {world.protocol.phase} at {universe.now}"
    ending = world.protocol.ended.ending
    assert ending in (ev.Ending.COMPLETE, ev.Ending.QUORUM_LOST, ev.Ending.NOT_GATHERED)
    # Each agent exactly once in every tick, in turn order: no decision is applied twice and none is passed over.
    whole = [agent for _ in range(TICKS) for agent in range(N)]
    applied = [choice.agent for choice in world.applied]
    assert applied == whole[: len(applied)]
    assert (len(applied) == len(whole)) == (ending == ev.Ending.COMPLETE)
    # A decision is the answer to the turn it was applied for: the agents answer with the turn's sequence, which grows.
    for agent in range(N):
        answers = [c.action for c in world.applied if c.agent == agent and c.outcome == ev.Outcome.DECIDED]
        assert answers == sorted(set(answers))


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32), loss=st.sampled_from([0.0, 0.1, 0.3]), together=st.booleans())
def test_loss_delay_repetition_and_reordering_alone_lose_no_decision(seed, loss, together):
    universe = Universe(seed, loss, [], together=together)
    universe.run()
    assert universe.world.protocol.ended.ending == ev.Ending.COMPLETE
    decided = [choice for choice in universe.world.applied if choice.outcome == ev.Outcome.DECIDED]
    # A turn is sent about 20 times before its deadline: at a loss of 0.3 each way one in 10^5 is late all the same.
    assert len(decided) >= N * TICKS - 1

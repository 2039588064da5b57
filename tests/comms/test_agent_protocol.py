"""What an agent does, event by event and at exact times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.agent_protocol import AgentProtocol
from marl_sched.comms.protocol.rules import AgentRules
from marl_sched.errors import InvalidMessageError
from tests.comms.driver import RUN, US, of, said

FRAME = wire.Frame(**US, env="toy", agents=2, heartbeat=0.5, problem=b"f")
CHANNEL = "state/1"


class Notebook:
    """A mind that writes down what it is told."""

    def __init__(self, channels: Sequence[str] = (CHANNEL,)) -> None:
        self.channels, self.learned = channels, []
        self.remembers, self.forgotten = False, 0

    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        self.learned.append("met")
        return "bot", self.channels

    def learn(self, channel: str, payload: bytes) -> None:
        if payload == b"bad":
            raise InvalidMessageError("bad")
        self.learned.append(payload)

    def forget(self) -> bool:
        self.forgotten += 1
        return self.remembers


class AgentDriver:
    """Agent 1 of two, which finds the world and joins in the constructor unless `join=False`."""

    def __init__(self, *, join: bool = True, channels: Sequence[str] = (CHANNEL,), **rules: Any) -> None:
        self.mind = Notebook(channels)
        self.protocol = AgentProtocol(
            AgentRules(**rules), run=RUN, agent=1, policy="p", identity="me", mind=self.mind, now=0.0
        )
        self.first = self.at(0.0, ev.Reopened())
        if join:
            self.join(0.25)

    def at(self, now: float, event: ev.Event | None = None) -> list[ev.Effect]:
        while self.protocol.wake_at < now:
            self.protocol.handle(ev.Wake(), self.protocol.wake_at)
        return self.protocol.handle(event or ev.Wake(), now)

    def hear(self, now: float, key: str, message: wire.Message) -> list[ev.Effect]:
        return self.at(now, ev.Received(key, wire.encode(message)))

    def answer(self, now: float, message: wire.Message) -> list[ev.Effect]:
        return self.at(now, ev.Answered(self.protocol._question.number, wire.encode(message)))

    def join(self, now: float, *, epoch: str = "e1", sequence: int = 1) -> None:
        self.answer(now, wire.Frame(**{**US, "epoch": epoch}, env="toy", agents=2, heartbeat=0.5, problem=b"f"))
        self.answer(now, snapshot(sequence, epoch=epoch))
        welcome = wire.Welcome(run=RUN, epoch=epoch, agent=1, incarnation=self.protocol.incarnation)
        self.hear(now, "bot/1/turn", welcome)

    def turn(self, now: float, sequence: int = 1, needs: int = 1, **changes: Any) -> list[ev.Effect]:
        fields = {"tick": 3, "agent": 1, "incarnation": self.protocol.incarnation, "sequence": sequence, "noise": 0.5}
        turn = wire.Turn(**{**US, **fields, "needs": {CHANNEL: needs}, **changes})
        return self.hear(now, "bot/1/turn", turn)


def snapshot(sequence: int = 1, *, phase: str = "running", epoch: str = "e1") -> wire.Snapshot:
    return wire.Snapshot(run=RUN, epoch=epoch, tick=3, phase=phase, channels=[news(sequence, epoch=epoch)])


def news(sequence: int, payload: bytes | None = None, *, epoch: str = "e1", channel: str = CHANNEL) -> wire.News:
    return wire.News(run=RUN, epoch=epoch, channel=channel, sequence=sequence, payload=payload or b"%d" % sequence)


def test_agent_finds_the_world_catches_up_announces_itself_and_says_hello():
    agent = AgentDriver(join=False)
    assert agent.first == [ev.Watch(keys.WORLD_ALIVE), ev.Ask(1, keys.FRAME, None)]
    assert agent.answer(0.25, FRAME) == [
        ev.Subscribe("bot/1/turn"),
        ev.Subscribe(CHANNEL, quiet=True),
        ev.Subscribe(keys.CLOCK),
        ev.Ask(2, keys.snapshot(1), wire.SnapshotRequest(**US, agent=1)),
    ]
    assert agent.answer(0.5, snapshot()) == [
        ev.Announce("bot/1/alive/me-1"),
        ev.Put("bot/1/hello", wire.Hello(**US, agent=1, incarnation="me-1", policy="p"), control=True),
    ]
    assert agent.protocol.state == "joining"
    agent.hear(0.6, "bot/1/turn", wire.Welcome(**US, agent=1, incarnation="me-1"))
    assert agent.protocol.state == "serving"


def test_question_that_is_not_answered_is_put_again():
    agent = AgentDriver(join=False, answer=1.0)
    assert agent.at(1.0) == [ev.Ask(2, keys.FRAME, None)]
    assert agent.at(1.5, ev.Answered(1, wire.encode(FRAME))) == []  # to the first question, which is given up


def test_hello_is_said_again_until_welcomed_and_then_a_heartbeat_with_all_counts():
    agent = AgentDriver(join=False, retry=0.25)
    agent.answer(0.0, FRAME)
    agent.answer(0.0, snapshot())
    assert [type(m) for m in said(agent.at(0.25), wire.Hello)] == [wire.Hello]
    agent.hear(0.3, "bot/1/turn", wire.Welcome(**US, agent=1, incarnation="me-1"))
    (beat,) = said(agent.at(0.8), wire.Beat)
    assert beat == wire.Beat(**US, agent=1, incarnation="me-1", tick=3, counts={"snapshots": 1, "heard": 1})


def test_turn_is_decided_when_all_that_it_needs_is_known():
    agent = AgentDriver()
    assert agent.turn(1.0, needs=2) == []
    (choose,) = agent.hear(1.1, CHANNEL, news(2))
    assert (choose.turn.sequence, choose.turn.noise) == (1, 0.5)
    decision = wire.Decision(**US, tick=3, agent=1, incarnation="me-1", sequence=1, action=9)
    assert agent.at(1.2, ev.Chosen(1, 9)) == [ev.Put("bot/1/decision", decision, control=True)]
    assert agent.mind.learned[-1] == b"2"


def test_turn_that_comes_again_gets_the_same_decision_without_a_second_choice():
    agent = AgentDriver()
    assert of(agent.turn(1.0), ev.Choose)
    agent.at(1.1, ev.Chosen(1, 9))
    effects = agent.turn(1.2)
    assert of(effects, ev.Choose) == []
    assert [d.action for d in said(effects, wire.Decision)] == [9]


def test_turn_that_comes_again_while_a_state_is_lacking_asks_for_the_snapshot():
    agent = AgentDriver()
    agent.turn(1.0, needs=2)
    assert of(agent.turn(1.1, needs=2), ev.Ask)
    (choose,) = of(agent.answer(1.2, snapshot(2)), ev.Choose)
    assert choose.turn.needs == {CHANNEL: 2}


def test_turn_that_the_world_has_gone_past_is_not_decided():
    agent = AgentDriver()
    agent.hear(1.0, CHANNEL, news(5))
    assert of(agent.turn(1.1, needs=4), ev.Choose) == []


def test_older_state_and_state_of_another_channel_are_not_believed():
    agent = AgentDriver()
    agent.hear(1.0, CHANNEL, news(5))
    agent.hear(1.0, CHANNEL, news(4))
    agent.hear(1.0, CHANNEL, news(6, channel="state/0"))
    assert agent.mind.learned[-1] == b"5"
    assert agent.protocol.counts["unparsed"] == 1


def test_sequence_that_jumps_is_asked_about_instead_of_believed():
    agent = AgentDriver()
    (ask,) = of(agent.hear(1.0, CHANNEL, news(2**62 - 1)), ev.Ask)
    assert ask.key == keys.snapshot(1)
    assert of(agent.hear(1.5, CHANNEL, news(2**62 - 1)), ev.Ask) == []
    agent.answer(1.6, snapshot(1))
    assert of(agent.turn(1.7, needs=2), ev.Choose) == []
    assert of(agent.hear(1.8, CHANNEL, news(2)), ev.Choose)  # the true state is heard as before


def test_forged_clock_of_another_epoch_does_not_end_an_agent():
    agent = AgentDriver()
    effects = agent.hear(1.0, keys.CLOCK, wire.Clock(run=RUN, epoch="forged", tick=9, phase="over"))
    assert of(effects, ev.End) == []
    assert of(effects, ev.Ask)  # who is the world?
    agent.join(1.1)
    assert agent.protocol.state == "serving"
    assert agent.protocol.incarnation == "me-1"


def test_end_of_the_run_is_answered_by_a_goodbye():
    agent = AgentDriver()
    effects = agent.hear(1.0, keys.CLOCK, wire.Clock(**US, tick=9, phase="over"))
    (goodbye,) = said(effects, wire.Goodbye)
    assert (goodbye.incarnation, goodbye.counts["snapshots"]) == ("me-1", 1)
    assert effects[-1] == ev.End(ev.Ending.COMPLETE)
    assert agent.at(2.0, ev.Interrupted(15)) == []


def test_world_that_comes_back_as_another_epoch_meets_a_new_incarnation_with_an_empty_mind():
    agent = AgentDriver()
    agent.hear(1.0, keys.CLOCK, wire.Clock(run=RUN, epoch="e2", tick=0, phase="gathering"))
    agent.mind.channels = ("state/0",)
    effects = agent.answer(1.1, wire.Frame(run=RUN, epoch="e2", env="toy", agents=2, heartbeat=0.5, problem=b"f"))
    assert ev.Unsubscribe(CHANNEL) in effects  # a narrower view
    assert ev.Subscribe("state/0", quiet=True) in effects
    assert ev.Withdraw("bot/1/alive/me-1") in effects
    assert ev.Announce("bot/1/alive/me-2") in agent.answer(
        1.2, wire.Snapshot(run=RUN, epoch="e2", tick=0, phase="gathering", channels=[])
    )


def test_world_that_is_silent_is_reached_for_by_a_new_session_and_met_as_the_same_incarnation():
    agent = AgentDriver(silence=4.0)
    effects: list[ev.Effect] = []
    while not of(effects, ev.Reopen):
        now = agent.protocol.wake_at
        effects = agent.at(now)
    assert now == pytest.approx(4.25)
    assert of(agent.at(4.5, ev.Reopened()), ev.Ask)
    effects = agent.answer(4.6, FRAME)
    assert ev.Subscribe(CHANNEL, quiet=True) in effects
    assert ev.Announce("bot/1/alive/me-1") in agent.answer(4.7, snapshot())


def test_clock_and_turns_show_that_the_world_lives():
    agent = AgentDriver(silence=4.0)
    for step in range(2, 20):
        assert of(agent.hear(float(step), keys.CLOCK, wire.Clock(**US, tick=3, phase="running")), ev.Reopen) == []
    assert agent.protocol.counts["reopened"] == 0


def test_agent_that_slept_does_not_take_the_world_for_silent():
    agent = AgentDriver(silence=4.0)
    effects = agent.protocol.handle(ev.Wake(), 20.0)
    assert of(effects, ev.Reopen) == []
    assert agent.protocol.counts["slept"] == 1


def test_fenced_agent_comes_back_as_another_incarnation():
    agent = AgentDriver()
    fenced = wire.Fenced(**US, agent=1, incarnation="me-1", why="given_up", reason="")
    effects = agent.hear(1.0, "bot/1/turn", fenced)
    assert ev.Withdraw("bot/1/alive/me-1") in effects
    agent.join(1.1)
    assert agent.protocol.incarnation == "me-2"
    assert of(agent.hear(1.2, "bot/1/turn", fenced), ev.Withdraw) == []  # said to the one before


def test_agent_whose_place_is_taken_gives_up_after_a_while():
    agent = AgentDriver(join=False, taken=5.0)
    agent.answer(0.0, FRAME)
    agent.answer(0.0, snapshot())
    taken = wire.Fenced(**US, agent=1, incarnation="me-1", why="taken", reason="another process decides")
    agent.hear(1.0, "bot/1/turn", taken)
    for now in (2.0, 3.0, 4.0, 5.0):
        agent.hear(now, "bot/1/turn", taken)
    assert agent.at(5.9) is not None
    assert agent.protocol.ended is None
    assert agent.at(6.0) == [ev.End(ev.Ending.FAILED, "another process decides")]


def test_session_on_which_no_question_is_answered_is_opened_again():
    agent = AgentDriver(join=False, silence=4.0)
    assert agent.at(4.0) == [ev.Reopen()]
    assert of(agent.at(4.5, ev.Reopened()), ev.Ask)


def test_agent_without_a_world_gives_up_after_its_time():
    agent = AgentDriver(join=False, silence=100.0)
    agent.at(59.9)
    assert agent.protocol.ended is None
    assert of(agent.at(60.0), ev.End) == [ev.End(ev.Ending.FAILED, "no world of run 'run' answered within 60 s")]


def test_state_that_does_not_parse_is_counted_and_asked_for_again_by_the_next_turn():
    agent = AgentDriver()
    assert of(agent.hear(1.0, CHANNEL, news(2, b"bad")), ev.Warn)
    agent.turn(1.1, needs=2)
    assert of(agent.turn(1.2, needs=2), ev.Ask)
    assert agent.protocol.counts["unparsed"] == 1


def test_refusal_ends_an_agent_that_is_not_in_and_nobody_else():
    refused = wire.Refused(**US, reason="no")
    agent = AgentDriver()
    assert of(agent.hear(1.0, "bot/1/turn", refused), ev.End) == []
    newcomer = AgentDriver(join=False)
    newcomer.answer(0.0, FRAME)
    newcomer.answer(0.0, snapshot())
    assert newcomer.hear(0.1, "bot/1/turn", refused) == [ev.End(ev.Ending.FAILED, "no")]


def test_world_of_another_version_is_named():
    agent = AgentDriver(join=False)
    payload = wire.encode(FRAME).replace(b"frame.2", b"frame.1")
    (end,) = of(agent.at(0.1, ev.Answered(1, payload)), ev.End)
    assert end.reason == "the world speaks another version of the protocol: frame.1, this is 2"


def test_every_incarnation_begins_with_an_empty_memory_and_one_that_joins_under_way_says_so():
    agent = AgentDriver(join=False)
    agent.mind.remembers = True
    agent.answer(0.0, FRAME)
    assert of(agent.answer(0.0, snapshot()), ev.Warn) == [ev.Warn("memory", "begins with an empty memory at 3")]
    assert (agent.mind.forgotten, agent.protocol.counts["empty_memory"]) == (1, 1)
    fenced = wire.Fenced(**US, agent=1, incarnation="me-1", why="given_up", reason="late")
    agent.hear(1.0, "bot/1/turn", fenced)
    agent.join(1.1)
    assert (agent.protocol.incarnation, agent.mind.forgotten) == ("me-2", 2)


def test_incarnation_keeps_its_memory_through_a_new_session():
    agent = AgentDriver(silence=4.0)
    while not of(agent.at(agent.protocol.wake_at), ev.Reopen):
        pass
    agent.at(4.5, ev.Reopened())
    agent.join(4.6)
    assert (agent.protocol.incarnation, agent.mind.forgotten) == ("me-1", 1)


def test_decision_says_how_many_decisions_the_memory_held():
    agent = AgentDriver()
    agent.turn(1.0)
    (decision,) = said(agent.at(1.1, ev.Chosen(1, 9, 4)), wire.Decision)
    assert decision.remembered == 4

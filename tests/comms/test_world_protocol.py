"""What the world does, event by event and at exact times; the numbers in the names are those of comms/PROTOCOL.md."""

from __future__ import annotations

import math

import pytest

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from tests.comms.driver import EPOCH, RUN, US, WorldDriver, of, said, turns

TURN_0 = wire.Turn(**US, tick=0, agent=0, incarnation="a", sequence=1, noise=0.25, needs={"state/0": 1})


def running(**options) -> tuple[WorldDriver, wire.Turn]:
    """Two agents that joined at 1.0, the first of which has its turn."""
    world = WorldDriver(**options)
    (turn,) = turns(world.gathered(1.0))
    return world, turn


def test_run_begins_with_the_last_hello_by_a_welcome_and_the_first_turn():
    world = WorldDriver()
    assert said(world.hello(1.0, 0), wire.Welcome) == [wire.Welcome(**US, agent=0, incarnation="a")]
    assert world.hello(1.0, 1) == [
        ev.Note(1, "joined"),
        ev.Put("bot/1/turn", wire.Welcome(**US, agent=1, incarnation="a"), control=True),
        ev.Put("bot/0/turn", TURN_0, control=True),
        ev.Put(keys.CLOCK, wire.Clock(**US, tick=0, phase="running")),
    ]


def test_decision_is_applied_and_the_next_agent_asked_at_once():
    world, turn = running()
    effects = world.decide(1.25, turn, action=7)
    assert of(effects, ev.Apply) == [ev.Apply((ev.Choice(0, 7, ev.Outcome.DECIDED, 0.25, "a/1"),))]
    assert [t.agent for t in turns(effects)] == [1]
    assert [n.sequence for n in said(effects, wire.News)] == [2, 2]


def test_channels_that_did_not_change_are_not_told_again():
    world, _ = running()
    same = world.protocol.handle(ev.PlantAdvanced(0, (ev.Request(0, 0.25),), {"state/1": b"new"}), 1.1)
    assert [(news.channel, news.sequence) for news in said(same, wire.News)] == [("state/1", 2)]


def test_01_turn_is_sent_again_whenever_it_was_not_answered_for_so_long():
    world, turn = running(resend=0.125)
    assert world.protocol.wake_at == 1.125
    assert world.at(1.12) == []
    assert world.at(1.125) == [ev.Put("bot/0/turn", turn, control=True)]
    assert turns(world.at(1.2)) == []
    assert turns(world.at(1.25)) == [turn]
    world.decide(1.3, turn)
    assert [t.agent for t in turns(world.at(1.425))] == [1]


def test_02_decision_that_comes_twice_is_applied_once():
    world, turn = running()
    world.decide(1.1, turn, action=4)
    assert world.decide(1.1, turn, action=4) == [ev.Count("stale")]
    assert [choice.action for choice in world.applied] == [4]


def test_03_second_decision_with_another_action_for_an_open_turn_is_counted_as_a_contradiction():
    world, turns_of = WorldDriver(together=True), {}
    for turn in turns(world.gathered()):
        turns_of[turn.agent] = turn
    world.decide(1.1, turns_of[0], action=1)
    assert world.decide(1.2, turns_of[0], action=2) == [ev.Count("contradicted")]
    world.decide(1.3, turns_of[1], action=3)
    assert [(choice.agent, choice.action) for choice in world.applied] == [(0, 1), (1, 3)]


@pytest.mark.parametrize("field", ["tick", "incarnation", "sequence"])
def test_04_decision_that_answers_another_turn_changes_nothing(field):
    world, turn = running()
    other = "b" if field == "incarnation" else 9
    assert world.decide(1.05, turn, **{field: other}) == [ev.Count("stale")]
    assert world.applied == []


@pytest.mark.parametrize("field", ["run", "epoch"])
def test_05_message_of_another_run_or_epoch_is_counted_and_dropped(field):
    world, turn = running()
    assert world.decide(1.05, turn, **{field: "other"}) == [ev.Count("other_epoch")]
    assert world.applied == []


def test_06_late_agent_idles_at_its_deadline_and_not_before():
    world, turn = running(deadline=2.0)
    world.keep_alive(2.99, 0)
    assert of(world.at(2.999), ev.Apply) == []
    effects = world.at(3.0)
    assert effects[:3] == [
        ev.Count("missed_deadlines"),
        ev.Note(0, "late", 2.0),
        ev.Apply((ev.Choice(0, 0, ev.Outcome.LATE),)),
    ]
    assert world.decide(3.05, turn) == [ev.Count("stale")]


def test_07_agent_that_is_late_too_often_in_a_row_is_given_up_and_fenced():
    world, _ = running(n=1, deadline=1.0, patience=2)
    world.at(2.0)
    assert ev.Note(0, "silent", 2.0) in world.at(3.0)
    assert world.slot(0).state == "lost"
    (fenced,) = said(world.at(3.1, ev.TokenAppeared("bot/0/alive/a")), wire.Fenced)
    assert fenced.why == "given_up"


def test_08_successors_inherit_the_misses_and_the_slot_is_barred_for_a_while():
    world, _ = running(n=1, deadline=1.0, patience=1, bar=60.0, standstill=1000.0)
    world.at(2.0)
    world.hello(2.0, 0, "b")
    assert ev.Note(0, "barred") in world.at(3.0)
    (fenced,) = said(world.hello(3.5, 0, "c"), wire.Fenced)
    assert fenced.why == "barred"
    world.at(62.9)
    assert said(world.hello(63.0, 0, "c"), wire.Welcome)
    assert world.slot(0).missed == 1  # one more miss and it is barred again
    (turn,) = turns(world.at(63.1))
    world.decide(63.2, turn)
    assert world.slot(0).missed == 0


def test_09_killed_agent_is_waited_for_in_lockstep_and_its_successor_takes_the_turn():
    world, turn = running(grace=5.0)
    effects = world.gone(1.5, 0)
    assert effects[:2] == [ev.Note(0, "gone", 0.5), ev.Note(-1, "standstill")]
    assert world.protocol.phase == "standstill"
    for now in (2.0, 3.0, 4.0, 5.0, 6.0):
        world.keep_alive(now)
        assert world.applied == []
    effects = world.hello(6.4, 0, "b")
    (again,) = turns(effects)
    assert (again.incarnation, again.sequence, again.tick) == ("b", 2, 0)
    assert ev.Note(-1, "running", pytest.approx(4.9)) in effects
    assert world.decide(6.45, turn) == [ev.Count("stale")]  # of the one that is dead
    world.decide(6.5, again, action=3)
    assert world.applied == [ev.Choice(0, 3, ev.Outcome.DECIDED, pytest.approx(0.1), "b/2")]
    assert world.slot(0).losses == 0


def test_10_killed_agent_without_a_successor_is_lost_when_the_grace_period_is_over():
    world, _ = running(grace=5.0, quorum=0.5)
    world.gone(1.5, 0)
    for now in (3.0, 4.5, 6.0):
        world.keep_alive(now)
    assert of(world.at(6.49), ev.Apply) == []
    effects = world.at(6.5)
    assert ev.Note(0, "lost", 5.5) in effects
    assert of(effects, ev.Apply) == [ev.Apply((ev.Choice(0, 0, ev.Outcome.ABSENT),))]
    assert [t.agent for t in turns(effects)] == [1]
    assert world.slot(0).losses == 1


def test_11_frozen_agent_that_returns_within_the_grace_period_goes_on_as_the_same_incarnation():
    world, turn = running(grace=5.0)
    world.gone(1.5, 0)
    effects = world.at(3.0, ev.TokenAppeared("bot/0/alive/a"))
    assert ev.Note(0, "returned") in effects
    assert turns(effects) == [turn]
    world.decide(3.1, turn, action=2)
    assert [(c.action, c.outcome) for c in world.applied] == [(2, ev.Outcome.DECIDED)]


def test_12_frozen_agent_that_returns_later_is_fenced_and_comes_back_as_another_incarnation():
    world, turn = running(grace=1.0)
    world.gone(1.5, 0)
    world.at(2.5)
    (fenced,) = said(world.beat(4.0, 0), wire.Fenced)
    assert (fenced.incarnation, fenced.why) == ("a", "unknown")
    assert of(world.decide(4.0, turn), ev.Apply) == []
    assert said(world.hello(4.2, 0, "b"), wire.Welcome)


def test_13_agent_without_a_turn_that_says_nothing_is_missing():
    world, _ = running(unheard=3.0, deadline=30.0)
    world.beat(2.0, 1)
    assert ev.Note(1, "unheard") not in world.at(4.9)
    assert ev.Note(1, "unheard") in world.at(5.0)
    assert ev.Note(1, "returned") in world.beat(5.5, 1)


def test_14_agent_that_flaps_cannot_hold_its_turn_open_for_ever():
    world, _ = running(deadline=2.0, grace=5.0, patience=9)
    now = 1.0
    while not world.applied and now < 30.0:
        now += 0.5
        world.gone(now, 0)
        world.at(now + 0.25, ev.TokenAppeared("bot/0/alive/a"))
        world.keep_alive(now + 0.25)
    assert now + 0.25 == pytest.approx(1.0 + 2.0 + 5.0, abs=0.5)  # the step of this loop
    assert world.applied[0].outcome in (ev.Outcome.LATE, ev.Outcome.ABSENT)


def test_15_all_agents_killed_ends_the_run_with_a_reason_and_nothing_played():
    world, _ = running(grace=5.0, standstill=60.0)
    world.gone(1.5, 0)
    world.gone(1.5, 1)
    now = 1.5
    while world.protocol.ended is None and now < 100.0:
        now = world.protocol.wake_at
        world.at(now)
    assert now == 61.5
    assert world.protocol.ended.ending == ev.Ending.QUORUM_LOST
    assert world.applied == []


def test_16_world_that_slept_blames_nobody():
    world, turn = running(deadline=2.0, grace=0.0, clock="free")
    effects = world.after_sleep(31.1)  # it wanted to be woken at 1.1
    assert effects[0] == ev.Note(-1, "slept", 30.0)
    assert of(effects, ev.Apply) == []
    assert [t.agent for t in turns(effects)] == [0]
    for agent in (0, 1):  # its links were cut while it slept
        assert of(world.gone(31.2, agent), ev.Apply) == []
        world.at(31.5, ev.TokenAppeared(f"bot/{agent}/alive/a"))
    world.decide(32.0, turn, action=5)
    assert [(c.action, c.outcome) for c in world.applied] == [(5, ev.Outcome.DECIDED)]
    assert world.slot(0).losses == world.slot(1).losses == 0


def test_17_free_clock_waits_for_nobody_who_is_gone():
    world, _ = running(clock="free", grace=0.0)
    effects = world.gone(1.5, 0)
    assert ev.Note(0, "lost", 0.5) in effects
    assert of(effects, ev.Apply) == [ev.Apply((ev.Choice(0, 0, ev.Outcome.ABSENT),))]


def test_18_paced_clock_begins_a_tick_at_its_time_and_ends_it_at_the_next():
    world, turn = running(clock="paced", pace=10.0, deadline=99.0, patience=9)
    world.decide(2.0, turn)
    (turn,) = turns(world.at(2.1)) or [None]
    assert turn.agent == 1
    world.decide(3.0, turn)
    for now in (5.0, 7.0, 9.0):
        world.keep_alive(now)
    assert turns(world.at(10.9)) == []
    (turn,) = turns(world.at(11.0))  # tick 1: ten seconds after the run began
    assert (turn.tick, turn.agent) == (1, 0)
    for now in (11.5, 13.5, 15.5, 17.5, 19.5):
        world.keep_alive(now)
    effects = world.at(21.0)
    outcomes = [(c.agent, c.outcome) for apply in of(effects, ev.Apply) for c in apply.choices]
    assert outcomes == [(0, ev.Outcome.LATE), (1, ev.Outcome.LATE)]
    assert ev.Count("tick_overruns") in effects


def test_19_agents_that_do_not_come_are_named_when_the_time_is_up():
    world = WorldDriver(n=3, ready=60.0)
    world.hello(1.0, 1)
    for now in range(2, 60, 2):
        world.beat(now, 1)
    world.at(60.0)
    assert world.protocol.phase == "over"
    world.goodbye(60.1, 1)
    assert world.protocol.ended == ev.End(ev.Ending.NOT_GATHERED, "not there within 60 s: bot_0, bot_2")


def test_20_agent_that_leaves_for_good_is_not_waited_for_and_may_join_again():
    world, _ = running()
    assert ev.Note(1, "left") in world.goodbye(1.1, 1)
    assert world.slot(1).counts == {"heard": 4}
    world.decide(1.2, TURN_0)
    assert [(c.agent, c.outcome) for c in world.applied] == [(0, ev.Outcome.DECIDED), (1, ev.Outcome.ABSENT)]
    assert said(world.hello(1.3, 1, "b"), wire.Welcome)


def test_21_hello_without_a_token_takes_no_slot():
    world = WorldDriver(n=1)
    hello = wire.Hello(**US, agent=0, incarnation="x", policy="p")
    for i in range(100):
        assert said(world.say(0.05 * i, 0, hello), wire.Welcome) == []
    assert said(world.hello(5.0, 0, "a"), wire.Welcome)
    assert world.slot(0).missed == 0


def test_22_token_that_comes_after_its_hello_is_as_good():
    world = WorldDriver(n=1)
    world.say(1.0, 0, wire.Hello(**US, agent=0, incarnation="a", policy="p"))
    assert said(world.at(1.01, ev.TokenAppeared("bot/0/alive/a")), wire.Welcome)


def test_23_agent_of_another_version_is_told_so():
    world = WorldDriver(n=1)
    payload = wire.encode(wire.Hello(**US, agent=0, incarnation="a", policy="p")).replace(b"hello.2", b"hello.1")
    (refused,) = said(world.at(1.0, ev.Received("bot/0/hello", payload)), wire.Refused)
    assert refused.reason == "this world speaks version 2 of the protocol, the agent said hello.1"


@pytest.mark.parametrize(
    "key",
    [
        "bot/" + "9" * 5000 + "/decision",
        "bot/7/decision",
        "bot/-1/hello",
        "bot/٣/hello",
        "state/0",
        "",
        "bot/0/alive/a",
    ],
    ids=lambda key: key[:20],
)
def test_24_key_that_is_nobodys_is_counted_and_dropped(key):
    world, _ = running()
    (count, warn) = world.at(1.01, ev.Received(key, b"x"))
    assert count == ev.Count("unparsed")
    assert len(warn.text) < 200
    assert ev.Count("unparsed") in world.at(1.02, ev.TokenAppeared("bot/" + "9" * 5000 + "/alive/a"))


def test_25_queries_beyond_the_bound_are_not_answered():
    world = WorldDriver(n=2)
    answers = [bool(of(world.at(1.0, ev.Queried(keys.FRAME, b"", i)), ev.Reply)) for i in range(100)]
    assert sum(answers) == 32
    assert of(world.at(1.5, ev.Queried(keys.FRAME, b"", 100)), ev.Reply)


def test_26_refusals_to_one_agent_are_bounded():
    world, _ = running()
    intruder = wire.Beat(**US, agent=0, incarnation="x", tick=0, counts={})
    fenced = [said(world.say(1.0, 0, intruder), wire.Fenced) for _ in range(50)]
    assert sum(map(len, fenced)) == 1


def test_27_everything_remembered_of_strangers_is_bounded():
    world, _ = running()
    for i in range(1000):
        world.at(1.01, ev.TokenAppeared(f"bot/0/alive/x{i}"))
    assert len(world.slot(0).tokens) <= 8


def test_28_signal_ends_the_run_when_all_have_left():
    world, _ = running()
    effects = world.at(1.5, ev.Interrupted(15))
    assert said(effects, wire.Clock)[-1].phase == "over"
    world.goodbye(1.6, 0)
    assert world.goodbye(1.7, 1)[-1] == ev.End(ev.Ending.INTERRUPTED, "signal 15")
    assert world.protocol.wake_at == math.inf


def test_29_end_of_the_run_waits_for_goodbyes_no_longer_than_the_farewell():
    world, turn = running(n=1, ticks=1, farewell=2.0)
    assert said(world.decide(1.5, turn), wire.Clock)[-1].phase == "over"
    world.at(3.4)
    assert world.protocol.ended is None
    assert world.at(3.5)[-1] == ev.End(ev.Ending.COMPLETE)


def test_a_world_that_is_over_does_not_look_at_its_slots_again_and_again():
    """An agent that is not heard any more is due at 3 s after its last word, long before the farewell's end."""
    world, turn = running(n=1, ticks=1, farewell=20.0, unheard=3.0)
    world.decide(1.5, turn)
    for _ in range(100):
        now = world.protocol.wake_at
        world.after_sleep(now)
        assert world.protocol.wake_at > now
    assert world.protocol.phase == "over"


def test_frame_and_snapshot_say_run_epoch_and_no_more_than_the_agent_may_hear():
    world, _ = running()
    (frame,) = of(world.at(1.0, ev.Queried(keys.FRAME, b"", 1)), ev.Reply)
    assert frame.message == wire.Frame(run=RUN, epoch=EPOCH, env="toy", agents=2, heartbeat=0.5, problem=b"f")
    request = wire.encode(wire.SnapshotRequest(**US, agent=1))
    (reply,) = of(world.at(1.0, ev.Queried(keys.snapshot(1), request, 2)), ev.Reply)
    assert [news.channel for news in reply.message.channels] == ["state/1"]


def test_clock_is_told_once_a_heartbeat():
    world, _ = running(heartbeat=0.5, deadline=30.0)
    times = []
    while world.protocol.wake_at < 3.2:
        now = world.protocol.wake_at
        if said(world.after_sleep(now), wire.Clock):
            times.append(now)
        world.keep_alive(now)
    assert times == [1.5, 2.0, 2.5, 3.0]


def test_30_memory_is_noted_where_an_incarnation_first_decides_with_one():
    world = WorldDriver(1, grace=5.0)
    (turn,) = turns(world.gathered(1.0))
    for remembered in (0, 1):
        effects = world.decide(1.1, turn, remembered=remembered)
        assert [note.event for note in of(effects, ev.Note)] == ["memory began"] * (remembered == 0)
        (turn,) = turns(effects)
    assert (world.slot(0).memory_began, world.slot(0).remembered) == (0, 1)
    world.gone(1.2, 0)
    (turn,) = turns(world.hello(1.3, 0, "b"))
    assert ev.Note(0, "memory began") in world.decide(1.4, turn, remembered=0)
    assert (turn.tick, world.slot(0).memory_began, world.slot(0).remembered) == (2, 2, 0)


def test_30_agent_without_a_memory_has_none_in_its_slot():
    world = WorldDriver(1)
    (turn,) = turns(world.gathered(1.0))
    world.decide(1.1, turn)
    assert (world.slot(0).memory_began, world.slot(0).remembered) == (None, None)

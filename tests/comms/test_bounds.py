"""Everything that strangers can fill has a bound."""

from __future__ import annotations

import logging

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from marl_sched.comms.metrics.histogram import Histogram
from marl_sched.comms.metrics.run_metrics import MAX_EVENTS, RunMetrics
from marl_sched.comms.metrics.throttle import ThrottledLog
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.transport.inbox import Inbox
from tests.comms.driver import WorldDriver


def test_newer_message_takes_the_place_of_one_that_waits_by_the_same_key():
    inbox = Inbox()
    for i in range(1000):
        inbox.put("a", ev.Received("a", b"%d" % i))
    inbox.put("b", ev.Received("b", b"x"))
    assert [inbox.get(0), inbox.get(0), inbox.get(0)] == [ev.Received("a", b"999"), ev.Received("b", b"x"), None]
    assert inbox.dropped == {"replaced": 999}


def test_quiet_events_wait_as_the_newest_of_their_place_until_somebody_is_attentive():
    inbox = Inbox()
    assert inbox.get(0.0, attentive=False) is None
    for payload in (b"1", b"2"):
        inbox.put("state", ev.Received("state", payload), quiet=True)
    inbox.put("turn", ev.Received("turn", b"t"))
    assert inbox.get(0.0, attentive=False) == ev.Received("turn", b"t")
    assert inbox.get(0.0, attentive=False) is None
    assert inbox.get(0.0) == ev.Received("state", b"2")
    inbox.put("state", ev.Received("state", b"3"), quiet=True)  # somebody waits for it
    assert inbox.get(0.0) == ev.Received("state", b"3")
    assert not inbox.dropped


def test_keys_beyond_the_bound_find_no_place():
    inbox = Inbox(max_pending=3)
    assert [inbox.put(i, ev.Wake()) for i in range(5)] == [True, True, True, False, False]
    inbox.inject(ev.Interrupted(15))  # what the process itself has to say always does
    assert [inbox.get(0) for _ in range(4)] == [ev.Wake(), ev.Wake(), ev.Wake(), ev.Interrupted(15)]
    assert inbox.dropped == {"no_place": 2}


def test_log_has_one_line_per_kind_and_second_and_says_how_many_were_held_back(caplog):
    throttled = ThrottledLog(logging.getLogger("test"))
    for i in range(1000):
        throttled.warn("flood", "x" * 5000, i / 1000)
    throttled.warn("other", "y", 0.5)
    throttled.warn("flood", "z", 1.0)
    assert [len(message) for message in caplog.messages] == [300, 1, len("z (and 999 more of this kind)")]


@given(values=st.lists(st.floats(1e-6, 100.0), min_size=1, max_size=200), share=st.sampled_from([0.5, 0.99]))
def test_quantiles_are_within_two_percent(values, share):
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    exact = np.quantile(values, share, method="inverted_cdf")
    assert exact * (1 - 1e-9) <= histogram.quantile(share) <= exact * 1.02 * (1 + 1e-9)


def test_quantile_of_nothing_is_none():
    assert Histogram().quantile(0.5) is None


def test_events_of_a_report_are_bounded():
    metrics = RunMetrics()
    for _ in range(MAX_EVENTS + 5):
        metrics.note_event(0, "crew_0", "joined")
    assert len(metrics.events) == MAX_EVENTS
    assert metrics.counts["events_not_kept"] == 5


KEYS = st.one_of(
    st.text(max_size=60),
    st.builds("bot/{}/{}".format, st.integers(-1, 10**9), st.sampled_from(["hello", "decision", "alive/a", "turn"])),
)
MESSAGES = st.one_of(
    st.binary(max_size=60),
    st.builds(
        lambda agent, action, epoch: wire.encode(
            wire.Decision(run="run", epoch=epoch, tick=0, agent=agent, incarnation="a", sequence=1, action=action)
        ),
        st.integers(0, 5), st.integers(0, 2**61), st.sampled_from(["e1", "e2", ""]),
    ),
)  # fmt: skip


@given(said=st.lists(st.tuples(KEYS, MESSAGES), max_size=30))
def test_whatever_is_said_by_whatever_key_the_world_goes_on(said):
    world = WorldDriver(n=2, deadline=2.0)
    world.gathered(1.0)
    for step, (key, payload) in enumerate(said):
        for event in (
            ev.Received(key, payload),
            ev.TokenAppeared(key),
            ev.TokenVanished(key),
            ev.Queried(key, payload, 1),
        ):
            world.at(1.0 + step / 100, event)
    assert world.protocol.ended is None
    assert all(choice.agent in (0, 1) for choice in world.applied)

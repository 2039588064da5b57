"""Work whose standard error is a pipe says every half minute how far it is."""

from __future__ import annotations

import io

import pytest

from marl_sched.cli.progress import Lines


@pytest.fixture
def clock():
    """A clock that says what a test puts into it."""
    return {"now": 100.0}


def test_a_line_comes_every_half_minute_with_share_and_time_left(clock):
    """After 40 s a quarter is done: the other three take 120 s. After 50 s more it is not yet time for a third line."""
    out = io.StringIO()
    tell = Lines(out, every=30.0, clock=lambda: clock["now"])
    for now, done in ((100.0, 0.0), (129.0, 0.2), (140.0, 0.25), (169.0, 0.5), (170.0, 0.5), (190.0, 0.9)):
        clock["now"] = now
        tell("condition", done)
    assert out.getvalue().splitlines() == [
        "condition: 25 % done, about 120 s left",
        "condition: 50 % done, about 70 s left",
    ]


def test_work_that_has_only_begun_promises_no_time(clock):
    out = io.StringIO()
    tell = Lines(out, every=30.0, clock=lambda: clock["now"])
    clock["now"] = 131.0
    tell("edf", 0.0)
    assert out.getvalue() == "edf: 0 % done\n"


def test_short_work_says_nothing(clock):
    out = io.StringIO()
    tell = Lines(out, every=30.0, clock=lambda: clock["now"])
    for share in (0.0, 0.5, 1.0):
        clock["now"] += 9.0
        tell("edf", share)
    assert out.getvalue() == ""

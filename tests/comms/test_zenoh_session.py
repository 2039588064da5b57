"""Zenoh as it is set up here, between sessions of this process."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.transport.endpoints import is_loopback, settle_port
from marl_sched.comms.transport.zenoh_session import ZenohTransport, hub, spoke
from marl_sched.errors import DeploymentError


@contextmanager
def star(n: int) -> Iterator[list[ZenohTransport]]:
    """A hub and n clients."""
    run, endpoint = f"test-{uuid.uuid4().hex[:12]}", settle_port("tcp/127.0.0.1:0")
    with ExitStack() as stack:
        sessions = [hub(run, endpoint, "crew"), *(spoke(run, endpoint, 30.0) for _ in range(n))]
        for session in sessions:
            stack.callback(session.close)
        yield sessions


def events(session: ZenohTransport, count: int) -> list[ev.Event]:
    return [session.receive(30.0) for _ in range(count)]


def test_newest_state_of_a_burst_arrives_and_the_turn_behind_it():
    with star(1) as (world, agent):
        agent.subscribe("plane/0/now")
        agent.subscribe("crew/0/turn")
        agent.announce("crew/0/alive/a")
        world.watch("crew/*/alive/*")
        assert world.receive(30.0) == ev.TokenAppeared("crew/0/alive/a")  # the subscriptions went the same way before
        for i in range(200):
            world.put("plane/0/now", b"%d" % i + bytes(400))
        world.put("crew/0/turn", b"turn", control=True)
        heard = {"plane/0/now": b"", "crew/0/turn": b""}  # the turn may overtake the states: its priority is higher
        while not (heard["crew/0/turn"] and heard["plane/0/now"].startswith(b"199")):
            event = agent.receive(30.0)
            heard[event.key] = event.payload


def test_stranger_can_say_nothing_that_the_world_says_and_hears_no_decision():
    with star(2) as (world, agent, stranger):
        world.subscribe("crew/*/decision")
        world.watch("crew/*/alive/*")
        agent.subscribe("world/clock")
        agent.subscribe("crew/0/turn")
        agent.subscribe("plane/0/now")
        stranger.subscribe("**")
        for session, token in ((agent, "crew/0/alive/a"), (stranger, "crew/1/alive/b")):
            session.announce(token)
        assert {event.key for event in events(world, 2)} == {"crew/0/alive/a", "crew/1/alive/b"}
        for key in ("world/clock", "crew/0/turn", "plane/0/now"):
            stranger.put(key, b"forged", control=True)
        stranger.put("crew/1/decision", b"mark", control=True)
        agent.put("crew/0/decision", b"mine", control=True)
        assert {event.payload for event in events(world, 2)} == {b"mark", b"mine"}
        world.put("world/clock", b"true", control=True)
        assert agent.receive(30.0) == ev.Received("world/clock", b"true")
        assert stranger.receive(30.0) == ev.Received("world/clock", b"true")
        assert stranger.receive(0.3) is None


def test_stranger_cannot_answer_in_the_worlds_place():
    with star(2) as (world, agent, stranger):
        world.serve("world/frame")
        stranger.serve("world/frame")
        agent.ask(1, "world/frame", b"")
        query = world.receive(30.0)
        world.reply(query.query, b"true")
        assert agent.receive(30.0) == ev.Answered(1, b"true")
        assert stranger.receive(0.3) is None


def test_session_that_is_opened_again_hears_and_is_seen_again():
    with star(1) as (world, agent):
        world.watch("crew/*/alive/*")
        agent.announce("crew/0/alive/a")
        assert world.receive(30.0) == ev.TokenAppeared("crew/0/alive/a")
        agent.reopen()
        assert world.receive(30.0) == ev.TokenVanished("crew/0/alive/a")
        agent.announce("crew/0/alive/a")
        assert world.receive(30.0) == ev.TokenAppeared("crew/0/alive/a")


@pytest.mark.parametrize(
    ("endpoint", "why"), [("tcp/nosuchhost.invalid:7447", "[nN]ame"), ("tcp/127.0.0.1:1", "Connection refused")]
)
def test_why_there_is_no_world_is_said(endpoint, why):
    with pytest.raises(DeploymentError, match=rf"no world at {endpoint} within 0\.1 s: .*{why}") as error:
        spoke("run", endpoint, 0.1)
    assert ".rs:" not in str(error.value)


@pytest.mark.parametrize(
    ("endpoint", "loopback"),
    [
        ("tcp/127.0.0.1:1", True),
        ("tcp/localhost:1", True),
        ("tcp/[::1]:1", True),
        ("tcp/0.0.0.0:1", False),
        ("tcp/a:1", False),
    ],
)
def test_loopback_is_told_apart_from_addresses_that_others_reach(endpoint, loopback):
    assert is_loopback(endpoint) == loopback

"""Zenoh as it is set up here, between two sessions of this process."""

from __future__ import annotations

import uuid

import pytest

from marl_sched.comms.session import hub, settle_port, spoke
from marl_sched.errors import DeploymentError


def test_states_told_in_one_burst_all_arrive_in_order():
    run, endpoint = f"test-{uuid.uuid4().hex[:12]}", settle_port("tcp/127.0.0.1:0")
    with hub(run, endpoint) as world, spoke(run, endpoint, 30.0) as agent:
        agent.subscribe("plane/0/now")
        agent.announce("crew/0/alive/a")
        world.watch("crew/*/alive/*")
        assert world.receive(30.0) is not None  # the subscription went the same way before
        told = [b"%04d" % i + bytes(400) for i in range(200)]
        for payload in told:
            world.put("plane/0/now", payload)
        heard = []
        while len(heard) < len(told) and (event := agent.receive(5.0)) is not None:
            heard.append(event.payload)
    assert heard == told


def test_host_that_does_not_exist_is_said_to_be_the_reason():
    with pytest.raises(
        DeploymentError, match=r"no world at tcp/nosuchhost\.invalid:7447 within 0.1 s: .*[nN]ame"
    ) as error:
        spoke("run", "tcp/nosuchhost.invalid:7447", 0.1).__enter__()
    assert "Unable to connect" in str(error.value)
    assert ".rs:" not in str(error.value)


def test_refused_connection_is_said_to_be_the_reason():
    endpoint = settle_port("tcp/127.0.0.1:0")
    with pytest.raises(DeploymentError, match=r"within 0\.1 s: Connection refused"):
        spoke("run", endpoint, 0.1).__enter__()

"""Routers between a world and its agents: the same run, and what the loss of one costs."""

from __future__ import annotations

import signal
import uuid

import pytest

from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.process import SIGNALS
from marl_sched.comms.security.access import named_rules, router_rules
from marl_sched.errors import InvalidOptionError
from marl_sched.problem import Problem

LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 12}
TWO = ("tls/127.0.0.1:0", "tls/127.0.0.1:0")


def world(**changes) -> WorldOptions:
    defaults = {
        "problem": Problem("airme", count=1, horizon=100, view=LOCAL), "run": f"test-{uuid.uuid4().hex[:12]}",
        "listen": "tls/127.0.0.1:0", "routers": TWO, "deadline": 30.0, "ready_timeout": 200.0, "standstill": 200.0,
        "grace": 60.0,
    }  # fmt: skip
    return WorldOptions(**{**defaults, **changes})


@pytest.mark.slow
def test_run_by_two_routers_of_which_one_is_killed_is_the_one_without_messages(in_process):
    pytest.importorskip("zenoh")
    pytest.importorskip("onnxruntime", reason="the extra [light] is not installed")
    from marl_sched.comms.launcher import Deployment

    given, killed = world(), []
    with Deployment(DeployOptions(world=given, policy="random", runtime="onnx")) as deployment:

        def kill_one(phase: str, tick: int, horizon: int) -> None:
            if phase == "running" and tick >= 20 and not killed:
                deployment.signal("router_0", signal.SIGKILL)
                killed.append(tick)

        report = deployment.wait(kill_one)
    assert killed
    assert report.ending.exit_code == 0
    assert report.restarts == {"router_0": 1}
    assert "returned" in [event.event for event in report.events]
    assert not report.deaths
    told, reference = report.as_json(), in_process(given, ["random"] * 7)
    assert (told["decisions"], told["rewards"]) == (reference["decisions"], reference["rewards"])


def test_routers_are_refused_without_certificates():
    with pytest.raises(InvalidOptionError, match="routers: expected an endpoint on tls/"):
        world(routers=("tcp/127.0.0.1:0",))
    pytest.importorskip("zenoh")
    from marl_sched.comms.router import route

    before = {number: signal.getsignal(number) for number in SIGNALS}
    with pytest.raises(InvalidOptionError, match="router: expected --certs"):
        route(world(listen=TWO[0]))
    for number, handler in before.items():
        signal.signal(number, handler)


def test_agents_have_the_rights_at_a_router_that_they_have_at_the_world():
    star, routed = (rules("run", "crew", [("plane/0/now",), ("plane/1/now",)]) for rules in (named_rules, router_rules))
    policies = {policy["subjects"][0]: policy["rules"] for policy in routed["policies"]}
    assert [policy for policy in routed["policies"] if policy in star["policies"]] == star["policies"]
    assert [rule for rule in routed["rules"] if rule in star["rules"]] == star["rules"]
    assert set(policies) - {policy["subjects"][0] for policy in star["policies"]} == {"world", "router"}

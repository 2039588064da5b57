"""The views of a running deployment: what they keep, what they show, and that they can only be read."""

from __future__ import annotations

import http.client
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from typing import Any

import pytest
from rich.console import Console

from marl_sched.comms.dashboard.terminal import picture, timeline
from marl_sched.comms.dashboard.watcher import LANE, RunState, Watcher
from marl_sched.comms.dashboard.web import MAX_FOLLOWERS, Server, serving
from marl_sched.comms.inproc import Bus, Threads
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.problem import Problem

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def observed(decided: list[tuple[int, int, int, str]] = (), **changes: Any) -> bytes:
    """A message about two agents, one of them lost; `decided` are (tick, agent, action, outcome)."""
    agents = [
        wire.Seen(name="bot_0", state="ready", policy="rule", turns=5, losses=0, silent=0.25),
        wire.Seen(name="bot_1", state="lost", policy="<b>rule</b>", turns=2, losses=1, silent=7.0),
    ]
    fields = {
        "run": "toy", "epoch": "e1", "tick": 9, "horizon": 20, "phase": "running", "unit": "hour", "agents": agents,
        "decisions": 7, "objectives": {"profit": 0.5}, "counts": {"denied": 3}, "last_error": "dropped <b>x</b>",
    }  # fmt: skip
    return wire.encode(wire.Observed(**{**fields, "decided": [wire.Decided(*one) for one in decided], **changes}))


def test_state_keeps_lanes_rates_and_conflicts_of_what_was_heard():
    state = RunState()
    assert state.as_dict(0.0) == {"phase": "waiting", "unreadable": 0}
    state.hear(observed([(3, 0, 2, "decided"), (4, 1, 5, "conflict")], decisions=10), 1.0)
    state.hear(observed([(6, 0, 0, "decided"), (6, 9, 1, "decided")], decisions=30), 3.0)
    state.hear(b"garbage", 3.5)
    told = state.as_dict(4.0)
    assert told["decisions_per_s"] == 10.0  # 20 in 2 s
    assert (told["conflicts"], told["silent_s"], state.unreadable) == (1, 1.0, 1)
    assert [agent["lane"] for agent in told["agents"]] == [[(3, 2, "decided"), (6, 0, "decided")], [(4, 5, "conflict")]]
    state.hear(observed(epoch="e2", decisions=4), 5.0)  # the world was started again, and counts from its own start
    assert state.as_dict(5.0)["decisions_per_s"] == 0.0
    json.dumps(told)


def test_what_an_observer_keeps_is_bounded():
    state = RunState()
    for tick in range(2 * LANE):
        state.hear(observed([(tick, 0, 1, "decided")]), tick / 100)
    assert len(state.lanes[0]) == LANE
    assert len(state._counted) <= 502  # five seconds of messages


def test_timeline_shows_choices_until_the_next_one_and_those_in_vain():
    lane = [(0, 1, "decided"), (3, 0, "decided"), (4, 2, "conflict"), (5, 3, "decided")]
    assert timeline(lane, tick=7, width=10) == "111.x333"
    assert timeline(lane, tick=7, width=4) == "x333"
    assert timeline([], tick=2, width=10) == "..."


def test_terminal_shows_agents_states_counts_and_the_last_error():
    state = RunState()
    state.hear(observed([(8, 0, 1, "decided")]), 0.0)
    console = Console(record=True, width=140, file=open("/dev/null", "w"))  # noqa: SIM115  # the console writes there
    console.print(picture(state.as_dict(3.0)))
    text = console.export_text()
    for what in ("run toy: running, hour 9 of 20", "bot_0", "lost", "denied 3", "dropped <b>x</b>", "profit 0.5",
                 "nothing heard of the world for 3 s", "11"):  # fmt: skip
        assert what in text


@pytest.fixture
def served() -> Iterator[tuple[Server, Any]]:
    """A page that watches a bus, and the node that speaks for the world."""
    bus = Bus()
    world = bus.node()
    with Watcher(bus.node) as watcher, serving(watcher, 0) as server:
        end = time.monotonic() + 30
        while not any(keys.OBSERVED in node.subscribed for node in bus.nodes):
            assert time.monotonic() < end
            time.sleep(0.01)
        yield server, world


def ask(server: Server, method: str, path: str, host: str = "127.0.0.1:1") -> tuple[int, bytes, Any]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.request(method, path, headers={"Host": host})
    answer = connection.getresponse()
    body = answer.read() if path != "/events" or answer.status != 200 else answer.fp.readline()
    connection.close()
    return answer.status, body, answer.headers


def told(server: Server) -> dict[str, Any]:
    return json.loads(ask(server, "GET", "/state")[1])


def wait_for(server: Server, phase: str) -> dict[str, Any]:
    end = time.monotonic() + 30
    while (state := told(server))["phase"] != phase:
        assert time.monotonic() < end, state
        time.sleep(0.02)
    return state


def test_page_state_and_events_are_served_to_this_machine(served):
    server, world = served
    assert told(server)["phase"] == "waiting"
    world.put(keys.OBSERVED, observed([(3, 0, 2, "decided")]))
    assert [agent["name"] for agent in wait_for(server, "running")["agents"]] == ["bot_0", "bot_1"]
    status, event, headers = ask(server, "GET", "/events")
    assert (status, headers["Content-Type"]) == (200, "text/event-stream")
    assert json.loads(event.removeprefix(b"data: "))["tick"] == 9
    for path, kind in (("/", "text/html"), ("/page.js", "text/javascript"), ("/page.css", "text/css")):
        status, body, headers = ask(server, "GET", path)
        assert status == 200
        assert body
        assert headers["Content-Type"].startswith(kind)
        assert "default-src 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize(
    ("method", "path", "host", "status"),
    [
        ("POST", "/state", "127.0.0.1:1", 501),
        ("PUT", "/", "127.0.0.1:1", 501),
        ("GET", "/../watcher.py", "127.0.0.1:1", 404),
        ("GET", "/watcher.py", "127.0.0.1:1", 404),
        ("GET", "/state", "evil.example:80", 403),
    ],
)
def test_page_can_only_be_read_and_only_by_its_own_name(served, method, path, host, status):
    assert ask(served[0], method, path, host)[0] == status


def test_metrics_are_served_for_prometheus(served):
    parser = pytest.importorskip("prometheus_client.parser", reason="the extra [metrics] is not installed")
    server, world = served
    world.put(keys.OBSERVED, observed())
    wait_for(server, "running")
    status, body, headers = ask(server, "GET", "/metrics")
    assert (status, headers["Content-Type"].partition(";")[0]) == (200, "text/plain")
    samples = [sample for family in parser.text_string_to_metric_families(body.decode()) for sample in family.samples]
    found = {(sample.name, *sorted(sample.labels.values())): sample.value for sample in samples}
    assert found["marl_sched_phase", "running", "toy"] == 1
    assert found["marl_sched_decisions_total", "toy"] == 7
    assert found["marl_sched_agent_losses_total", "bot_1", "toy"] == 1
    assert found["marl_sched_agents", "lost", "toy"] == 1
    assert found["marl_sched_events_total", "denied", "toy"] == 3
    assert found["marl_sched_objective", "profit", "toy"] == 0.5


def test_pages_that_follow_are_bounded(served):
    server, _ = served
    taken = [server.followers.acquire(blocking=False) for _ in range(MAX_FOLLOWERS)]
    assert all(taken)
    assert ask(server, "GET", "/events")[0] == 503


def test_world_tells_observers_every_decision_once(make_bus):
    bus = make_bus()
    problem = Problem("airme", scale="small", count=1, seed=0, episodes=1, horizon=24, view="local")
    world = WorldOptions(problem=problem, heartbeat=0.02)
    run, state = Threads(world, ["condition"] * 7, bus), RunState()
    said: list[bytes] = []
    bus.deliver = lambda key, payload: said.append(payload) or 1 if key == keys.OBSERVED else 1
    report = run.play()
    for payload in said:
        state.hear(payload, 0.0)
    decided = sorted((tick, agent, action) for agent, lane in enumerate(state.lanes) for tick, action, _ in lane)
    assert decided == sorted((d.time, int(d.agent.removeprefix("crew_")), d.action) for d in report.decisions)
    assert state.as_dict(0.0)["phase"] == "over"
    assert state.as_dict(0.0)["objectives"]["profit"] == report.M1


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_browser_shows_what_was_heard_as_text(served):
    server, world = served
    world.put(keys.OBSERVED, observed([(3, 0, 2, "decided")]))
    wait_for(server, "running")
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3000", "--dump-dom",
         f"{server.address}#once"],
        capture_output=True, text=True, timeout=240, check=True,
    )  # fmt: skip
    for what in ("run toy", "bot_0", ">lost<", "hour 9 of 20", "denied 3", "<rect"):
        assert what in done.stdout
    assert "&lt;b&gt;x&lt;/b&gt;" in done.stdout  # text of others stays text

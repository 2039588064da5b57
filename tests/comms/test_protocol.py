"""World and agents on a network in memory that loses, repeats and delays as the test says."""

from __future__ import annotations

import time

import msgspec
import numpy as np
import pytest

from marl_sched.comms import messages as wire
from marl_sched.comms.agent import Agent
from marl_sched.comms.options import AgentOptions, WorldOptions
from marl_sched.comms.session import Event
from marl_sched.errors import DeploymentError, InvalidOptionError

LOCAL = {"view": "local", "view_options": {"reach": 1, "comm": 1, "staleness": 12}}


def options(**changes) -> WorldOptions:
    """Seven crews; nobody is ever late unless the test says so."""
    return WorldOptions(**{"seed": 0, "hours": 60, "deadline": 30.0, "ready_timeout": 30.0, **LOCAL, **changes})


def assert_same_run(report, reference) -> None:
    assert report["decisions"] == reference["decisions"]
    assert report["rewards"] == reference["rewards"]
    assert report["M1"] == reference["M1"]


@pytest.mark.parametrize(
    "view",
    [
        LOCAL,
        {"view": "full"},
        {"view": "local", "view_options": {"reach": 0, "comm": 2}},
        {"view": "random", "view_options": {"staleness_most": 24, "fresh_share": 0.0}},
    ],
)
@pytest.mark.parametrize("policy", ["random", "condition"])
def test_distributed_run_equals_the_run_in_process(make_run, in_process, view, policy):
    given = options(**{"view_options": {}, **view})
    report = make_run(given, [policy] * 7).play()
    assert_same_run(report, in_process(given, [policy] * 7))
    assert report["missed_deadlines"] == report["unparsed"] == report["stale"] == 0
    assert report["deaths"] == []


def test_lost_and_repeated_messages_change_nothing(make_run, make_bus, in_process):
    rng = np.random.default_rng(0)
    bus = make_bus(lambda key, payload: int(rng.choice([0, 1, 2], p=[0.15, 0.7, 0.15])))
    given = options(hours=12)
    run = make_run(given, ["random"] * 7, bus)
    report = run.play()
    assert_same_run(report, in_process(given, ["random"] * 7))
    assert sum(agent.counts["snapshots"] for agent in run.agents) > 7  # somebody had to ask again
    assert report["stale"] > 0  # and some decision came twice


def test_agent_subscribes_to_the_clock_its_turns_and_its_views_channels_alone(make_run):
    run = make_run(options(hours=2), ["condition"] * 7)
    run.play()
    assert sorted(run.nodes[0].subscribed) == [
        "crew/0/status", "crew/0/told", "crew/0/turn", "crew/1/status", "crew/6/status",
        "plane/0/now", "plane/1/delayed", "plane/6/delayed", "world/clock",
    ]  # fmt: skip
    assert run.nodes[0].watched == {"world/alive"}


def test_snapshot_holds_no_more_than_the_view_allows(make_run):
    run = make_run(options(hours=2), ["condition"] * 7)
    run.play()
    answers = run.bus.node()
    request = wire.encode(wire.SnapshotRequest(agent=0))
    run.world._handle(Event("query", wire.SNAPSHOT, request, answers.inbox))
    snapshot = wire.decode(answers.inbox.get(), wire.Snapshot)
    assert set(snapshot.channels) == run.nodes[0].subscribed - {"crew/0/turn", "world/clock"}


def test_neither_turns_nor_frame_tell_the_key_of_the_noise(make_run):
    run = make_run(options(hours=5), ["condition"] * 7)
    run.play()
    key = int(run.world.simulator.episode_keys[0])
    encoded = {msgspec.msgpack.encode(key), key.to_bytes(8, "little"), key.to_bytes(8, "big")}
    assert not any(secret in payload for _, payload in run.bus.log for secret in encoded)


class Killed(BaseException):
    """Stands for SIGKILL: the thread ends where it is."""


def kill_at(run, agent: int, nth_decision: int, *, token_goes: bool) -> None:
    """Let an agent die just before its n-th decision leaves it."""
    count = 0

    def put(key: str, payload: bytes) -> None:
        nonlocal count
        count += key.endswith("/decision")
        if count == nth_decision:
            if token_goes:
                for token in [token for token in run.bus.tokens if token.startswith(f"crew/{agent}/")]:
                    run.bus.alive(token, "gone")
            raise Killed

    run.nodes[agent].on_put = put


def test_killed_agent_idles_from_then_on_and_delays_nobody(make_run, in_process):
    given = options(deadline=20.0)
    run = make_run(given, ["condition"] * 7)
    kill_at(run, 3, 2, token_goes=True)
    report = run.play()
    (death,) = report["deaths"]
    mine = [d for d in report["decisions"] if d["agent"] == "crew_3"]
    assert [d["outcome"] for d in mine[:2]] == ["decided", "absent"]
    assert {d["outcome"] for d in mine[1:]} == {"absent"}
    assert (death["agent"], death["event"], death["hour"]) == ("crew_3", "gone", mine[1]["hour"])
    assert death["waited_s"] < given.deadline  # the token's going ended the wait, not the deadline
    assert report["missed_deadlines"] == 0
    assert report["hours"] == given.hours
    before = [d for d in report["decisions"] if d["hour"] < death["hour"]]
    assert before == [d for d in in_process(given, ["condition"] * 7)["decisions"] if d["hour"] < death["hour"]]


def test_silent_agent_is_waited_for_no_longer_than_patience_allows(make_run):
    given = options(deadline=0.5, patience=2)
    run = make_run(given, ["condition"] * 7)
    kill_at(run, 3, 2, token_goes=False)
    report = run.play()
    mine = [d["outcome"] for d in report["decisions"] if d["agent"] == "crew_3"]
    assert mine[:4] == ["decided", "late", "late", "absent"]
    (death,) = [death for death in report["deaths"] if death["agent"] == "crew_3"]
    assert death["event"] == "silent"
    assert 1.0 <= death["waited_s"] < report["delay_bound_s"] == 2.0
    assert report["agents"][3]["waited_s"] == death["waited_s"]
    assert any(d["outcome"] == "decided" for d in report["decisions"] if d["agent"] == "crew_2")


def test_agent_that_is_alive_but_slow_delays_the_others_by_the_stated_bound_at_most(make_run, monkeypatch):
    monkeypatch.setattr("marl_sched.comms.agent.HEARTBEAT", 0.05)
    monkeypatch.setattr("marl_sched.comms.agent.REFUSED", 0.2)
    given = options(hours=400, deadline=0.2, patience=2)
    run = make_run(given, ["condition"] * 7)
    seat = run.world.roster.seats[3]

    class Slow:
        def choose(self, observation, uniform):
            time.sleep(0.5)
            return np.array([0])

    original = run.agent

    def agent(index: int) -> None:
        if index != 3:
            original(index)
            return
        slow = Agent(AgentOptions(agent=3, policy="condition"), run.nodes[3])
        slow.scheduler = Slow()
        try:
            slow.run()
        except DeploymentError as error:
            run.errors.append(error)

    def let_it_return(phase: str, moment: int, horizon: int) -> None:
        if phase == "running" and not seat.incarnation and not run.errors:
            time.sleep(0.02)

    run.agent = agent
    run.world._progress = let_it_return
    report = run.play()
    mine = [event for event in report["events"] if event["agent"] == "crew_3"]
    assert [e["event"] for e in mine if e["event"] != "late"] == ["joined", "silent"] * 3
    assert [e["event"] for e in mine].count("late") == 4
    assert report["delay_bound_s"] == 0.8
    assert report["agents"][3]["waited_s"] == pytest.approx(0.8, abs=0.4)  # the operating system's share
    assert "4 turns in a row were waited for in vain" in str(run.errors[0])


def test_successor_of_a_dead_agent_joins_and_decides(make_run):
    run = make_run(options(hours=400), ["condition"] * 7)
    kill_at(run, 3, 2, token_goes=True)
    node = run.nodes[3]
    died = node.on_put

    def put_and_be_reborn(key: str, payload: bytes) -> None:
        try:
            died(key, payload)
        except Killed:
            run.nodes[3] = run.bus.node()
            run.bus.nodes.remove(node)
            run.agent(3)  # the successor lives in the dying thread
            raise

    node.on_put = put_and_be_reborn
    report = run.play()
    joined = [e["hour"] for e in report["events"] if e["agent"] == "crew_3" and e["event"] == "joined"]
    (death,) = report["deaths"]
    assert joined == [0, joined[1]]
    assert joined[1] >= death["hour"]
    later = [d["outcome"] for d in report["decisions"] if d["agent"] == "crew_3" and d["hour"] > joined[1]]
    assert later
    assert "absent" not in later


def test_fenced_agent_comes_back_as_another_incarnation(make_run):
    run = make_run(options(hours=300), ["condition"] * 7)
    fenced = []

    def lose_the_token_once(key: str, payload: bytes) -> None:
        if key.endswith("/decision") and not fenced:  # the network, not the process, fails for a moment
            fenced.extend(token for token in run.bus.tokens if token.startswith("crew/3/"))
            run.bus.alive(fenced[0], "gone")
            run.bus.alive(fenced[0], "alive")

    run.nodes[3].on_put = lose_the_token_once
    report = run.play()
    assert [e["event"] for e in report["events"] if e["agent"] == "crew_3"] == ["joined", "gone", "joined"]
    incarnations = {
        wire.decode(payload, wire.Hello).incarnation for key, payload in run.bus.log if key == "crew/3/hello"
    }
    assert len(incarnations) == 2
    assert report["stale"] == 1  # the decision of the incarnation that was given up


def test_decision_is_applied_once_though_it_comes_thrice(make_run, make_bus, in_process):
    bus = make_bus(lambda key, payload: 3 if key.endswith("/decision") else 1)
    given = options(hours=20)
    report = make_run(given, ["random"] * 7, bus).play()
    reference = in_process(given, ["random"] * 7)
    assert_same_run(report, reference)
    last = 2  # copies of the last decision may come after the run
    assert 2 * len(reference["decisions"]) - last <= report["stale"] <= 2 * len(reference["decisions"])


def noise_on(run, key: str, payload: bytes) -> None:
    """Put a foreign message in with every hello."""
    intruder = run.bus.node()
    before = run.nodes[0].on_put

    def put(own_key: str, own_payload: bytes) -> None:
        if before is not None:
            before(own_key, own_payload)
        if own_key.endswith("/decision"):
            intruder.put(key, payload)

    run.nodes[0].on_put = put


FOREIGN = wire.encode(wire.Decision(tick=0, agent=1, incarnation="forged", sequence=1, target=5))
BEYOND = wire.encode(wire.Decision(tick=0, agent=99, incarnation="", sequence=0, target=0))


@pytest.mark.parametrize(
    ("key", "payload", "count"),
    [
        ("crew/1/decision", b"\xc1garbage", "unparsed"),
        ("crew/1/decision", b"", "unparsed"),
        ("crew/x/decision", FOREIGN, "unparsed"),
        ("crew/2/decision", FOREIGN, "unparsed"),  # speaks for crew 1
        ("crew/1/decision", FOREIGN, "stale"),
        ("crew/99/decision", BEYOND, "stale"),
        ("crew/1/hello", FOREIGN, "unparsed"),
    ],
)  # fmt: skip
def test_foreign_messages_are_counted_and_dropped(make_run, in_process, caplog, key, payload, count):
    given = options(hours=20)
    run = make_run(given, ["condition"] * 7)
    noise_on(run, key, payload)
    report = run.play()
    assert_same_run(report, in_process(given, ["condition"] * 7))
    assert report[count] > 0
    assert ("dropped a message" in caplog.text) == (count == "unparsed")


def test_agent_counts_and_drops_what_it_cannot_read(make_run, in_process):
    given = options(hours=20)
    run = make_run(given, ["condition"] * 7)
    noise_on(run, "plane/0/now", b"\xc1garbage")
    assert_same_run(run.play(), in_process(given, ["condition"] * 7))
    assert run.agents[0].counts["unparsed"] > 0
    assert run.errors == []


def test_agent_drops_a_channel_of_a_snapshot_that_it_cannot_read(make_run, in_process, caplog):
    given = options(hours=20)
    run = make_run(given, ["condition"] * 7)
    ask, spoilt = run.nodes[0].ask, []

    def spoil_the_first(key: str, payload: bytes, timeout: float) -> bytes | None:
        answer = ask(key, payload, timeout)
        if key != wire.SNAPSHOT or spoilt or answer is None:
            return answer
        snapshot = wire.decode(answer, wire.Snapshot)
        spoilt.append(key)
        snapshot.channels["plane/0/now"] = wire.News(sequence=1, payload=b"\xc1garbage")
        return wire.encode(snapshot)

    run.nodes[0].ask = spoil_the_first
    assert_same_run(run.play(), in_process(given, ["condition"] * 7))
    assert run.agents[0].counts["unparsed"] == 1
    assert run.errors == []
    assert "world/snapshot, plane/0/now" in caplog.text


def test_illegal_action_idles_the_agent_for_the_hour(make_run):
    run = make_run(options(hours=10), ["condition"] * 7)

    class Stubborn:
        def choose(self, observation, uniform):
            return np.array([10**6])

    original = run.agent

    def agent(index: int) -> None:
        if index != 2:
            original(index)
            return
        run.agents[2] = Agent(AgentOptions(agent=2, policy="condition"), run.nodes[2])
        run.agents[2].scheduler = Stubborn()
        run.agents[2].run()

    run.agent = agent
    report = run.play()
    mine = [d for d in report["decisions"] if d["agent"] == "crew_2"]
    assert [d["outcome"] for d in mine] == ["illegal"] * 10  # never at work, so asked every hour
    assert report["illegal"] == 10


def test_missing_agents_are_named_when_the_time_is_up(make_run):
    run = make_run(options(ready_timeout=1e-3), [])
    for agent in range(5):
        hello = wire.encode(wire.Hello(agent=agent, incarnation="a", policy="condition"))
        run.world.transport.inbox.put(Event("message", f"crew/{agent}/hello", hello))
    with pytest.raises(DeploymentError, match=r"not there within 0\.001 s: crew_5, crew_6"):
        run.play()


def test_agent_for_a_crew_that_does_not_exist_says_so(make_run):
    run = make_run(options(hours=2), ["condition"] * 8)
    run.play()
    (error,) = run.errors
    assert isinstance(error, InvalidOptionError)
    assert str(error) == "crew_7 does not exist: run 'run' has crew_0 to crew_6"


@pytest.mark.parametrize("reach", [0, 1])
def test_replaced_policy_file_changes_nobody_else_before_they_meet(make_run, save_policy, reach):
    given = options(hours=30, view_options={"reach": reach, "comm": reach})
    one, another = save_policy(1), save_policy(2)
    before = make_run(given, [one] * 7).play()["decisions"]
    after = make_run(given, [one] * 3 + [another] + [one] * 3).play()["decisions"]
    first = next(i for i, (old, new) in enumerate(zip(before, after, strict=False)) if old != new)
    assert before[first]["agent"] == after[first]["agent"] == "crew_3"
    others = [[d for d in decisions if d["agent"] != "crew_3"] for decisions in (before, after)]
    # With a reach of 0 nobody ever sees, hears or wants what crew 3 does; with 1 its neighbours soon do.
    assert (others[0] == others[1]) == (reach == 0)


def test_report_counts_messages_and_latencies(make_run):
    run = make_run(options(hours=30), ["condition"] * 7)
    report = run.play()
    sent = [key for key, _ in run.bus.log if key.startswith(("plane/", "world/")) or key.endswith(("status", "told"))]
    telemetry = {
        k: v for k, v in report["messages"]["sent"].items() if k not in ("crew/turn", wire.FRAME, wire.SNAPSHOT)
    }
    assert sum(v["count"] for v in telemetry.values()) == len(sent)
    assert report["messages"]["heard"]["crew/decision"]["count"] == len(report["decisions"])
    assert 0 < report["latency_ms"]["p50"] <= report["latency_ms"]["p99"]
    assert len(report["profit"]) == report["hours"] == 30
    assert np.mean(report["profit"]) == pytest.approx(report["M1"], abs=1e-12)
    assert 0 < report["view"]["visible_share"] < 0.5

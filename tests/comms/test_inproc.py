"""World and agents as threads on a network in memory that loses and repeats as the test says."""

from __future__ import annotations

import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from marl_sched import airme_v0
from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.decision_log import FileLog, Header, MemoryLog, Step, play_again, read_log
from marl_sched.comms.fork_server import warm_up
from marl_sched.comms.inproc import Threads, play
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import SimulatedPlant
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.replay import replay
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.problem import Problem

LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 12}


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """What is played here is compiled before: threads that compile would take each other's time."""
    warm_up(options(), ["random", "condition"])


def options(*, seed=0, horizon=60, view=LOCAL, **changes) -> WorldOptions:
    """Seven crews; nobody is ever late unless the test says so."""
    problem = Problem("airme", count=1, seed=seed, horizon=horizon, view=view)
    return WorldOptions(**{"problem": problem, "deadline": 30.0, "ready_timeout": 30.0, **changes})


def assert_same_run(report, reference) -> None:
    assert report["decisions"] == reference["decisions"]
    assert report["rewards"] == reference["rewards"]
    assert report["M1"] == reference["M1"]


@pytest.mark.parametrize(
    "view",
    [
        LOCAL,
        {"kind": "full"},
        {"kind": "local", "reach": 0, "comm": 2},
        {"kind": "random", "staleness_most": 24, "fresh_share": 0.0},
    ],
)
@pytest.mark.parametrize("policy", ["random", "condition"])
def test_distributed_run_equals_the_run_in_process(in_process, view, policy):
    given = options(view=view)
    report = play(given, [policy] * 7).as_json()
    assert_same_run(report, in_process(given, [policy] * 7))
    assert report["missed_deadlines"] == report["unparsed"] == report["stale"] == 0
    assert report["ending"] == {"kind": "complete", "reason": None, "exit_code": 0}


def test_lost_and_repeated_messages_change_nothing(make_run, make_bus, in_process):
    rng = np.random.default_rng(0)
    bus = make_bus(lambda key, payload: int(rng.choice([0, 1, 2], p=[0.15, 0.7, 0.15])))
    given = options(horizon=12)
    run = make_run(given, ["random"] * 7, bus)
    report = run.play().as_json()
    assert_same_run(report, in_process(given, ["random"] * 7))
    assert sum(agent.protocol.counts["snapshots"] for agent in run.agents) > 7  # somebody had to ask again


def test_agent_subscribes_to_the_clock_its_turns_and_its_views_channels_alone(make_run):
    run = make_run(options(horizon=2), ["condition"] * 7)
    run.play()
    assert sorted(run.agents[0].protocol.subscriptions) == [
        "crew/0/memory", "crew/0/status", "crew/0/turn", "crew/1/status", "crew/6/status",
        "plane/0/now", "plane/1/delayed", "plane/6/delayed", "world/clock",
    ]  # fmt: skip


def test_snapshot_holds_no_more_than_the_view_allows(make_run):
    run = make_run(options(horizon=2), ["condition"] * 7)
    run.play()
    world = run.world
    request = wire.encode(wire.SnapshotRequest(run="run", epoch=world.epoch, agent=0))
    (reply,) = world.protocol.handle(ev.Queried(keys.snapshot(0), request, 1), world._clock())
    said = {news.channel for news in reply.message.channels}
    assert said == run.agents[0].protocol.subscriptions - {"crew/0/turn", "world/clock"}


def test_neither_turns_nor_frame_tell_the_key_of_the_noise(make_run, make_bus):
    bus = make_bus(keep_log=True)
    run = make_run(options(horizon=5), ["condition"] * 7, bus)
    run.play()
    key = int(run.world.plant.simulator.episode_keys[0])
    encoded = {msgspec.msgpack.encode(key), key.to_bytes(8, "little"), key.to_bytes(8, "big")}
    assert bus.log
    assert not any(secret in payload for _, payload in bus.log for secret in encoded)


def test_decision_is_applied_once_though_it_comes_thrice(make_run, make_bus, in_process):
    bus = make_bus(lambda key, payload: 3 if key.endswith("/decision") else 1)
    given = options(horizon=20)
    report = make_run(given, ["random"] * 7, bus).play().as_json()
    assert_same_run(report, in_process(given, ["random"] * 7))


def test_illegal_action_idles_the_agent_for_the_epoch(make_run):
    run = make_run(options(horizon=10), ["condition"] * 7)
    original = run.run_agent

    def run_agent(index: int) -> None:
        if index == 2:
            from marl_sched.comms.mind import PolicyMind

            class Stubborn(PolicyMind):
                def choose(self, noise: float) -> tuple[int, int | None]:
                    return 10**6, None

            from marl_sched.comms.agent import Agent
            from marl_sched.comms.agent_options import AgentOptions

            agent = Agent(AgentOptions(agent=2, policy="condition"), run.nodes[2])
            agent.mind = agent.protocol._mind = Stubborn(agent.options)
            agent.run()
            return
        original(index)

    run.run_agent = run_agent
    report = run.play().as_json()
    mine = [d for d in report["decisions"] if d["agent"] == "crew_2"]
    assert [d["outcome"] for d in mine] == ["illegal"] * 10  # never at work, so asked every hour
    assert report["illegal"] == 10


def test_agent_that_does_not_exist_says_so(make_run):
    run = make_run(options(horizon=2), ["condition"] * 8)
    run.play()
    (error,) = run.errors
    assert isinstance(error, InvalidOptionError)
    assert str(error) == "crew_7 does not exist: run 'run' has crew_0 to crew_6"


def test_report_counts_messages_latencies_and_what_agents_counted(make_run):
    run = make_run(options(horizon=30), ["condition"] * 7)
    report = run.play().as_json()
    assert report["messages"]["heard"]["crew/decision"]["count"] == len(report["decisions"])
    assert 0 < report["latency_ms"]["p50"] <= report["latency_ms"]["p99"]
    assert len(report["profit"]) == report["time"] == 30
    assert np.mean(report["profit"]) == pytest.approx(report["M1"], abs=1e-12)
    assert 0 < report["view"]["visible_share"] < 0.5
    counted = [agent["counts"]["decisions"] for agent in report["agents"]]
    assert counted == [agent["turns"] for agent in report["agents"]]


# ---- the log of a run


def plant_of(given: WorldOptions) -> SimulatedPlant:
    return SimulatedPlant(given.domain, given.telemetry(), given.simulator())


def logged(path: Path, given: WorldOptions) -> FileLog:
    return FileLog(path, Header.of(given))


def test_log_plays_again_to_the_same_rewards(tmp_path, in_process):
    given, path = options(horizon=30), tmp_path / "run.jsonl"
    Threads(given, ["random"] * 7, commits=logged(path, given)).play()
    reference = in_process(given, ["random"] * 7)
    plant = plant_of(given)
    steps = [line for line in read_log(path) if isinstance(line, Step)]
    assert play_again(plant, steps, path) == len(reference["decisions"])
    assert [commit.reward for step in steps for commit in step.commits] == reference["rewards"]
    assert plant.summary().objectives["profit"] == reference["M1"]


@pytest.mark.parametrize("torn", [b"", b'{"type":"commit","comm'])
def test_world_goes_on_from_its_log_as_if_it_had_never_ended(tmp_path, in_process, torn):
    given, path = options(horizon=30), tmp_path / "run.jsonl"
    Threads(given, ["random"] * 7, commits=logged(path, given)).play()
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[: len(lines) // 2]) + torn)  # killed in the middle of the run
    report = Threads(given, ["random"] * 7, commits=logged(path, given)).play().as_json()
    assert_same_run(report, in_process(given, ["random"] * 7))


def test_log_of_another_problem_is_refused_with_what_differs(tmp_path):
    path = tmp_path / "run.jsonl"
    logged(path, options()).close()
    with pytest.raises(InvalidFileError, match="seed 0 instead of 1"):
        logged(path, options(seed=1))


def test_log_that_comes_out_otherwise_is_refused(tmp_path):
    given, path = options(horizon=30), tmp_path / "run.jsonl"
    memory = MemoryLog()
    Threads(given, ["random"] * 7, commits=memory).play()
    steps = [line for line in memory.lines if isinstance(line, Step)]
    first = msgspec.structs.replace(steps[0].commits[0], reward=0.5)
    with pytest.raises(InvalidFileError, match="commit 1: expected what this version plays"):
        play_again(plant_of(given), [Step(commits=[first])], path)


@pytest.mark.parametrize("content", [b"no json\n", b'{"type":"commit","commits":[]}\n'])
def test_file_that_is_no_log_is_refused(tmp_path, content):
    path = tmp_path / "run.jsonl"
    path.write_bytes(content)
    with pytest.raises(InvalidFileError, match="line 1"):
        read_log(path)


def test_replay_gives_the_report_of_the_run_and_its_picture(tmp_path):
    pytest.importorskip("matplotlib")
    given, path, picture = options(horizon=30), tmp_path / "run.jsonl", tmp_path / "run.png"
    report = Threads(given, ["random"] * 7, commits=logged(path, given)).play().as_json()
    again = replay(path, picture).as_json()
    for name in ("ending", "decisions", "rewards", "objectives", "M1", "profit", "view", "time"):
        assert again[name] == report[name], name
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_replay_of_a_log_that_ends_early_says_where(tmp_path):
    given, path = options(horizon=30), tmp_path / "run.jsonl"
    Threads(given, ["random"] * 7, commits=logged(path, given)).play()
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:10]))
    again = replay(path).as_json()
    assert again["ending"]["kind"] == "failed"
    assert again["ending"]["reason"] == f"the log ends at hour {again['time']}"
    assert len(again["decisions"]) == 9


@pytest.mark.parametrize("policy", ["random", "condition"])
@pytest.mark.parametrize("view", [LOCAL, {"kind": "full"}])
def test_simultaneous_run_equals_the_parallel_api(view, policy):
    given = options(conflict="priority", view=view)
    report = play(given, [policy] * 7).as_json()
    env = airme_v0.parallel_env(scale="small", split="test", horizon=60, view=view)
    env.reset(seed=0, options={"instance": given.problem.instances[0]})
    schedulers = {agent: create_scheduler(policy, "airme") for agent in env.agents}
    expected, rewards = [], []
    while env.agents:
        simulator = env.unwrapped.simulator
        free, hour = simulator.free_agents(0).tolist(), int(simulator.time[0])
        actions = {}
        for i in free:
            seen = {name: array.copy() for name, array in simulator.observe(np.array([i])).items()}
            noise = simulator.policy_noise(np.array([i]))
            actions[f"crew_{i}"] = int(schedulers[f"crew_{i}"].choose(seen, noise)[0])
        _, reward, _, _, infos = env.step(actions)
        rewards.append(next(iter(reward.values())))
        for i in free:
            outcome = "conflict" if infos[f"crew_{i}"]["conflict"] else "decided"
            expected.append({"hour": hour, "agent": f"crew_{i}", "action": actions[f"crew_{i}"], "outcome": outcome})
    assert report["decisions"] == expected
    assert [reward for reward in report["rewards"] if reward] == [reward for reward in rewards if reward]
    assert report["ending"]["kind"] == "complete"
    if policy == "random":
        assert "conflict" in {decision["outcome"] for decision in expected}


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/plant.example:7447", "tcp/[::]:7447"])
def test_endpoint_that_other_machines_reach_is_refused_unless_asked_for(endpoint):
    with pytest.raises(InvalidOptionError, match="is reached by other machines"):
        options(listen=endpoint)
    assert options(listen=endpoint, insecure=True).listen == endpoint


def test_clock_that_nobody_can_follow_ends_the_run_in_time_and_its_world_still_hears(make_run, tmp_path):
    """Every turn is overdue when it comes: thousands of them in a row, none inside the one before."""
    given = options(horizon=1500, clock="paced", pace=1e-6, report=str(tmp_path / "report.json"))
    run = make_run(given, ["condition"] * 7)
    report = run.play()
    assert report.ending.kind == "complete"
    assert report.time == 1500
    assert report.counts["tick_overruns"] > 1000
    again = make_run(options(horizon=10**6, clock="paced", pace=1e-6), ["condition"] * 7)
    timer = threading.Timer(3.0, lambda: again.world.transport.inject(ev.Interrupted(15)))
    timer.start()
    assert again.play().ending.kind == "interrupted"

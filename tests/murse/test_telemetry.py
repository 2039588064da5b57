"""What a deployed agent believes is what the simulator would show it, and it hears nothing that its view hides."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.agents.murse.lst import LeastLatestStart
from marl_sched.domain import get_domain
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.telemetry import TELEMETRY
from marl_sched.envs.murse.views import FullView, LocalView
from marl_sched.errors import InvalidMessageError
from tests.murse.problems import instances, problem

MURSE = get_domain("murse")
VIEWS = [FullView(), LocalView(sensing=2.0, comm=1.5), LocalView(sensing=6.0, comm=1.0)]


def local_states(sim: MurseSimulator) -> list:
    frame = TELEMETRY.frame(sim)
    return [TELEMETRY.local_state(frame, agent) for agent in range(int(sim.n_agents[0]))]


def tell(local_state, said: dict[str, bytes]) -> dict[str, np.ndarray]:
    for channel in local_state.channels:
        local_state.hear(channel, said[channel])
    return local_state.observe()


def play_at_random(sim: MurseSimulator, rng: np.random.Generator) -> None:
    """One turn that rarely waits, and also chooses what only looks legal, so that conflicts happen."""
    weights = sim.legal()[0].astype(float)
    weights[0] = 0.1
    sim.step(np.array([rng.choice(len(weights), p=weights / weights.sum())]))


def assert_equal(believed, seen, where) -> None:
    assert believed.keys() == seen.keys()
    for name, array in seen.items():
        assert believed[name].dtype == array.dtype
        assert believed[name].tobytes() == array.tobytes(), (name, *where)


@given(
    instance=instances(),
    view=st.sampled_from(VIEWS),
    mode=st.sampled_from(["plan", "online"]),
    simplification=st.sampled_from(["sparse", "distance"]),
    seed=st.integers(0, 100),
)
@settings(max_examples=40)
def test_messages_show_every_agent_its_observation_and_a_turn_changes_only_its_channels(
    instance, view, mode, simplification, seed
):
    sim = MurseSimulator([instance], view=view, mode=mode, simplification=simplification, seed=seed, horizon=2)
    agents, rng, said, possible = local_states(sim), np.random.default_rng(seed), {}, None
    for _ in range(60):
        before, said = said, TELEMETRY.messages(sim)
        changed = {channel for channel, payload in said.items() if before.get(channel) != payload}
        assert possible is None or changed <= possible
        assert TELEMETRY.messages(sim, changed) == {channel: said[channel] for channel in changed}
        for agent, local_state in enumerate(agents):
            assert_equal(tell(local_state, said), sim.observe(np.array([agent])), (agent, int(sim.time[0])))
        if sim.over[0]:
            break
        possible = set(TELEMETRY.turn_channels(sim, int(sim.acting[0])))
        play_at_random(sim, rng)
        possible = None if sim.elapsed[0] else possible


def test_random_play_under_a_local_view_meets_conflicts_and_remembers_them():
    sim = MurseSimulator(
        MURSE.instances("small", 1, 3), view=LocalView(sensing=9.0, comm=0.5), mode="online", horizon=3
    )
    rng, conflicts = np.random.default_rng(0), 0
    while not sim.over[0]:
        play_at_random(sim, rng)
        conflicts += bool(sim.conflict[0])
        for agent, local_state in enumerate(local_states(sim)):
            assert_equal(tell(local_state, TELEMETRY.messages(sim)), sim.observe(np.array([agent])), (agent,))
    assert conflicts > 2


def test_agents_hear_their_own_channels_or_what_all_hear():
    assert local_states(simulator(LocalView()))[1].channels == (
        "agent/1/commitments", "agent/1/estimates", "agent/1/tasks", "team/now",
    )  # fmt: skip
    assert local_states(simulator(FullView()))[1].channels == (
        "team/commitments", "team/estimates", "team/now", "team/tasks",
    )  # fmt: skip


def simulator(view, **options) -> MurseSimulator:
    """Two robots that both can do four tasks, which lie at (0, 0), (10, 0), (20, 0) and (30, 0)."""
    return MurseSimulator([problem([[4, 4]] * 4, waits=[(1, 0, 5)])], view=view, mode="online", **options)


def heard(sim: MurseSimulator, agent: int) -> dict[str, object]:
    said = TELEMETRY.messages(sim)
    return {c: msgspec.msgpack.decode(said[c]) for c in said if c.startswith(f"agent/{agent}/")}


def test_nothing_of_a_task_out_of_sight_or_an_agent_out_of_hearing_is_said():
    """Agents stand at the origin: task 1 is in sight, task 2 waits for it and so is too; 3 and 4 are not.

    Agent 0 takes task 2 at (10, 0): agent 1, at the origin, hears it no longer and is told of no commitment.
    """
    sim = simulator(LocalView(sensing=1.0, comm=1.0))
    said = heard(sim, 1)
    assert [told[0] for told in said["agent/1/tasks"]["tasks"]] == [0, 1]
    assert [told[0] for told in said["agent/1/commitments"]["agents"]] == [0, 1]
    sim.step(np.array([1]))
    sim.step(np.array([2]))  # agent 1 takes task 2, far from agent 0
    assert heard(sim, 0)["agent/0/commitments"] == {
        "type": "murse.commitments.1", "agents": [[0, 0, 0.0, 0.0]], "taken": [[0, 0, 0, 0, 4]], "free": [0],
    }  # fmt: skip
    assert {pair[0] for _, pairs in heard(sim, 0)["agent/0/estimates"]["tasks"] for pair in pairs} == {0}


def test_what_a_view_hides_changes_nothing_that_is_heard():
    sim = simulator(LocalView(sensing=1.0, comm=1.0))
    before = TELEMETRY.messages(sim)
    for name in ("x", "weight", "deadline"):
        sim.state.tasks[name][0, 3] += 1
    sim.state.pairs["mean"][0, 3] += 1.0
    sim.state.rows["episode"] += np.uint64(1)  # the key of all noise to come
    sim.state.curves[:] += 1.0  # how humans learn
    assert TELEMETRY.messages(sim) == before


def test_true_end_of_a_running_task_is_not_told():
    instance = MURSE.instances("small", 1, 1)[0]
    sim = MurseSimulator([instance], mode="online", durations="stochastic")
    rng = np.random.default_rng(1)
    while not (sim.state.tasks["finish"][0] > sim.state.rows["clock"][0]).any():
        play_at_random(sim, rng)
    running = np.flatnonzero(sim.state.tasks["finish"][0] > sim.state.rows["clock"][0])
    before = TELEMETRY.messages(sim)
    sim.state.tasks["finish"][0, running] += 7
    sim.state.pairs["true"][0, running] += 7
    assert TELEMETRY.messages(sim) == before


@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_planner_decides_on_what_it_was_told_as_on_the_simulator(margin):
    sim = MurseSimulator(MURSE.instances("small", 1, 4), mode="online", durations="stochastic", horizon=2)
    inside = LeastLatestStart(margin)
    inside.start(sim, np.ones(1, np.bool_))
    agents = local_states(sim)
    outside = [LeastLatestStart(margin) for _ in agents]
    inside_each = [LeastLatestStart(margin) for _ in agents]
    for each in inside_each:
        each.start(sim, np.ones(1, np.bool_))
    for each, local_state in zip(outside, agents, strict=True):
        tell(local_state, TELEMETRY.messages(sim))
        each.start(local_state.simulator(), np.ones(1, np.bool_))
    while not sim.over[0]:
        agent = int(sim.acting[0])
        tell(agents[agent], TELEMETRY.messages(sim))
        expected = inside_each[agent].decide(sim)
        assert outside[agent].decide(agents[agent].simulator()) == expected
        sim.step(expected)


def test_view_that_hides_gives_no_simulator_to_plan_with():
    sim = simulator(LocalView())
    local_state = local_states(sim)[0]
    tell(local_state, TELEMETRY.messages(sim))
    assert local_state.simulator() is None


def broken_payloads(said: dict[str, bytes]) -> dict[str, tuple[str, bytes]]:
    tasks, commitments, estimates = (
        msgspec.msgpack.decode(said[f"team/{kind}"]) for kind in ("tasks", "commitments", "estimates")
    )
    first, agent = tasks["tasks"][0], commitments["agents"][0]
    encode = msgspec.msgpack.encode
    return {
        "empty": ("team/now", b""),
        "not msgpack": ("team/tasks", b"\xc1\xff"),
        "another type": ("team/tasks", said["team/now"]),
        "a field too many": ("team/now", encode({**msgspec.msgpack.decode(said["team/now"]), "extra": 1})),
        "a task beyond": ("team/tasks", encode({**tasks, "tasks": [[99, *first[1:]]]})),
        "a task twice": ("team/tasks", encode({**tasks, "tasks": [first, first]})),
        "a wait for nothing": ("team/tasks", encode({**tasks, "tasks": [[*first[:6], [[99, 1]], []]]})),
        "near to what is not seen": ("team/tasks", encode({**tasks, "tasks": [[*first[:6], [], [3]]]})),
        "no number": ("team/tasks", encode({**tasks, "tasks": [[0, float("nan"), *first[2:]]]})),
        "an agent beyond": ("team/commitments", encode({**commitments, "agents": [agent, [9, *agent[1:]]]})),
        "without oneself": ("team/commitments", encode({**commitments, "agents": []})),
        "taken twice": ("team/commitments", encode({**commitments, "taken": [[0, 0, 0, 0, 4]] * 2})),
        "taken by nobody": ("team/commitments", encode({**commitments, "taken": [[0, 9, 0, 0, 4]]})),
        "estimates of nothing": ("team/estimates", encode({**estimates, "tasks": [[99, [[0, 4, 4.0, 0.0, 0]]]]})),
        "a negative mean": ("team/estimates", encode({**estimates, "tasks": [[0, [[0, 4, -4.0, 0.0, 0]]]]})),
    }


@pytest.mark.parametrize("flaw", list(broken_payloads(TELEMETRY.messages(simulator(FullView())))))
def test_broken_payload_is_refused_and_changes_nothing(flaw):
    sim = simulator(FullView())
    local_state, said = local_states(sim)[0], TELEMETRY.messages(sim)
    before = {name: array.copy() for name, array in tell(local_state, said).items()}
    channel, payload = broken_payloads(said)[flaw]
    with pytest.raises(InvalidMessageError):
        local_state.hear(channel, payload)
    assert_equal(local_state.observe(), before, (flaw,))


def test_agent_that_does_not_exist_and_a_channel_of_another_are_refused():
    sim = simulator(LocalView())
    with pytest.raises(InvalidMessageError, match="agent 2 does not exist: the team has agents 0 to 1"):
        TELEMETRY.local_state(TELEMETRY.frame(sim), 2)
    with pytest.raises(InvalidMessageError, match="not a channel"):
        local_states(sim)[0].hear("agent/1/tasks", TELEMETRY.messages(sim)["agent/1/tasks"])

"""What a deployed crew believes is what the simulator would show it, and it hears nothing that its view hides."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.domain import get_domain
from marl_sched.envs.airme import numpy_view
from marl_sched.envs.airme.local_state import AirmeLocalState
from marl_sched.envs.airme.messages import Frame, decode
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.views import FullView, LocalView, RandomView
from marl_sched.errors import InvalidMessageError

AIRME = get_domain("airme")
TELEMETRY = AIRME.telemetry
VIEWS = [
    FullView(),
    LocalView(reach=1, comm=1),
    LocalView(reach=0, comm=0, staleness=12),
    LocalView(reach=2, comm=1, staleness=12),
    LocalView(reach=1, comm=3, staleness=3),
    RandomView(reach_most=2, comm_most=2, staleness_most=12, fresh_share=0.3),
]


def simulator(view, *, seed=3, horizon=60, **options) -> AirmeSimulator:
    return AIRME.simulator(AIRME.instances("small", 1, seed), view=view, horizon=horizon, seed=seed, **options)


def local_states(sim: AirmeSimulator) -> list:
    frame = TELEMETRY.frame(sim)
    return [TELEMETRY.local_state(frame, agent) for agent in range(int(sim.n_agents[0]))]


def tell(local_state, said: dict[str, bytes]) -> dict[str, np.ndarray]:
    for channel in local_state.channels:
        local_state.hear(channel, said[channel])
    return local_state.observe()


def play_at_random(sim: AirmeSimulator, rng: np.random.Generator) -> None:
    """One turn that also chooses what only looks legal, so that conflicts happen."""
    sim.step(np.array([rng.choice(np.flatnonzero(sim.legal()[0]))]))


def assert_equal(believed, seen, where) -> None:
    assert believed.keys() == seen.keys()
    for name, array in seen.items():
        assert believed[name].dtype == array.dtype
        assert believed[name].tobytes() == array.tobytes(), (name, *where)


@pytest.mark.parametrize("view", VIEWS, ids=str)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=4)
def test_local_state_equals_observation_of_every_crew_at_every_turn(view, seed):
    sim, rng = simulator(view, seed=seed % 50, pad="small"), np.random.default_rng(seed)
    crews, frame = local_states(sim), decode(TELEMETRY.frame(sim), Frame)
    without_numba = [AirmeLocalState(frame, agent, numpy_view.observe) for agent in range(len(crews))]
    while not sim.over[0]:
        said = TELEMETRY.messages(sim)
        for agent, local_state in enumerate(crews):
            seen = sim.observe(np.array([agent]))
            assert_equal(tell(local_state, said), seen, (agent, int(sim.time[0])))
            assert_equal(tell(without_numba[agent], said), seen, (agent, int(sim.time[0]), "NumPy"))
        play_at_random(sim, rng)


def test_random_play_meets_conflicts_and_repairs_of_ones_own():
    sim, rng = simulator(LocalView(reach=2, comm=1, staleness=12), horizon=400), np.random.default_rng(0)
    conflicts = 0
    while not sim.over[0]:
        play_at_random(sim, rng)
        conflicts += bool(sim.conflict[0])
    assert conflicts > 10
    assert (sim.state.private_memory_at >= 0).sum() > conflicts


@pytest.mark.parametrize("view", VIEWS, ids=str)
def test_latecomer_needs_only_the_newest_messages(view):
    sim, rng = simulator(view), np.random.default_rng(1)
    while sim.time[0] < 40:
        play_at_random(sim, rng)
    for agent, local_state in enumerate(local_states(sim)):
        assert_equal(tell(local_state, TELEMETRY.messages(sim)), sim.observe(np.array([agent])), (agent,))


def test_crew_listens_to_its_sector_now_to_neighbours_delayed_and_to_no_one_else():
    sim = simulator(LocalView(reach=1, comm=2, staleness=12), seed=0)
    n = int(sim.n_agents[0])
    assert n == 7
    assert local_states(sim)[0].channels == (
        "crew/0/memory", "crew/0/status", "crew/1/status", "crew/2/status", "crew/5/status", "crew/6/status",
        "plane/0/now", "plane/1/delayed", "plane/6/delayed",
    )  # fmt: skip


def test_without_staleness_neighbours_sectors_are_heard_as_they_are():
    sim = simulator(LocalView(reach=1, comm=0), seed=0)
    assert local_states(sim)[3].channels == ("crew/3/status", "plane/2/now", "plane/3/now", "plane/4/now")


def test_local_state_refuses_a_channel_that_the_view_hides():
    sim = simulator(LocalView(reach=1, comm=1, staleness=12), seed=0)
    local_state, said = local_states(sim)[0], TELEMETRY.messages(sim)
    for channel in set(said) - set(local_state.channels):
        with pytest.raises(InvalidMessageError, match="not a channel"):
            local_state.hear(channel, said[channel])


def perturb(sim: AirmeSimulator, *, sector: int, crew: int) -> None:
    """Change everything there is to change about the planes of a sector and about a crew."""
    slots = np.arange(1, sim.max_actions)
    planes = sim.state.planes[0, slots[(slots - 1) % int(sim.n_agents[0]) == sector]]
    planes["hours"] += 1
    planes["landings"] += 1
    planes["broken"] ^= True
    planes["income"] += 1.0
    planes["job_cost"] += 1.0
    planes["mission_hours"] += 1
    sim.state.planes[0, slots[(slots - 1) % int(sim.n_agents[0]) == sector]] = planes
    sim.state.crews["job_hours"][0, crew] += 1


@pytest.mark.parametrize("staleness", [0, 12])
def test_hidden_sectors_crews_and_memories_change_nothing_that_a_crew_hears(staleness):
    sim, rng = simulator(LocalView(reach=1, comm=1, staleness=staleness), seed=0), np.random.default_rng(2)
    while sim.time[0] < 30:
        play_at_random(sim, rng)
    local_state, before = local_states(sim)[0], TELEMETRY.messages(sim)
    perturb(sim, sector=3, crew=3)
    sim.state.private_memory["hours"][:, 1:] += 1  # what other crews learnt
    sim.state.rows["episode"] += np.uint64(1)  # the key of all noise to come
    after = TELEMETRY.messages(sim)
    assert [channel for channel in local_state.channels if before[channel] != after[channel]] == []
    assert before["plane/3/now"] != after["plane/3/now"]  # and yet something was changed
    assert before["crew/3/status"] != after["crew/3/status"]


@pytest.mark.parametrize(("sector", "crew"), [(0, 0), (1, 1)])
def test_visible_sectors_and_crews_do_change_what_a_crew_hears(sector, crew):
    sim = simulator(LocalView(reach=1, comm=1), seed=0)
    local_state, before = local_states(sim)[0], TELEMETRY.messages(sim)
    perturb(sim, sector=sector, crew=crew)
    after = TELEMETRY.messages(sim)
    changed = {channel for channel in local_state.channels if before[channel] != after[channel]}
    assert changed == {f"plane/{sector}/now", f"crew/{crew}/status"}


def test_neighbours_present_stays_hidden_under_staleness():
    sim = simulator(LocalView(reach=1, comm=1, staleness=12), seed=0)
    local_state, before = local_states(sim)[0], TELEMETRY.messages(sim)
    perturb(sim, sector=1, crew=3)
    after = TELEMETRY.messages(sim)
    assert before["plane/1/now"] != after["plane/1/now"]
    assert all(before[channel] == after[channel] for channel in local_state.channels)


def test_who_chose_or_repairs_a_plane_is_not_on_the_wire():
    sim = simulator(FullView(), seed=0)
    sim.state.planes["crew"][0, 5] = 2
    before = TELEMETRY.messages(sim)
    sim.state.planes["crew"][0, 5] = 4
    sim.state.planes["chosen"][0, 6] = 1
    assert TELEMETRY.messages(sim) == before


def test_frame_tells_sizes_and_view_only():
    sim = simulator(LocalView(reach=1, comm=2, staleness=12), seed=0, pad="small")
    frame = msgspec.msgpack.decode(TELEMETRY.frame(sim))
    assert frame == {
        "type": "airme.frame.1",
        "n_planes": AIRME.instances("small", 1, 0)[0].n_planes,
        "n_crews": 7,
        "max_planes": 36,
        "max_crews": 8,
        "usage": sim.rules.usage.tolist(),
        "reach": 1,
        "comm": 2,
        "staleness": 12,
    }


def broken_payloads(good: bytes) -> dict[str, bytes]:
    said = msgspec.msgpack.decode(good)
    beyond = [[99, *said["planes"][0][1:]], *said["planes"][1:]]
    return {
        "empty": b"",
        "truncated": good[:-1],
        "not msgpack": b"\xc1\xff",
        "another version": msgspec.msgpack.encode({**said, "type": "airme.sector.2"}),
        "another type": msgspec.msgpack.encode({"type": "airme.memory.1", "planes": []}),
        "a field too many": msgspec.msgpack.encode({**said, "extra": 1}),
        "a field too few": msgspec.msgpack.encode({"type": said["type"], "planes": said["planes"]}),
        "a negative hour": msgspec.msgpack.encode({**said, "hour": -1}),
        "another sector's planes": msgspec.msgpack.encode({**said, "planes": said["planes"][1:]}),
        "a plane that is not there": msgspec.msgpack.encode({**said, "planes": beyond}),
    }


@pytest.mark.parametrize("flaw", list(broken_payloads(TELEMETRY.messages(simulator(FullView()))["plane/0/now"])))
def test_broken_payload_is_refused_and_changes_nothing(flaw):
    sim = simulator(FullView())
    local_state, said = local_states(sim)[0], TELEMETRY.messages(sim)
    before = {name: array.copy() for name, array in tell(local_state, said).items()}
    with pytest.raises(InvalidMessageError):
        local_state.hear("plane/0/now", broken_payloads(said["plane/0/now"])[flaw])
    assert_equal(local_state.observe(), before, (flaw,))


def test_crew_that_does_not_exist_gets_no_local_state():
    frame = TELEMETRY.frame(simulator(FullView(), seed=0))
    with pytest.raises(InvalidMessageError, match="crew 7 does not exist: the problem has crews 0 to 6"):
        TELEMETRY.local_state(frame, 7)

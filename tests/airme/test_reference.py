"""The compiled simulator against an independent plain-Python hour, to the last bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched import noise
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from tests.airme.reference import World, absorb, split_mix

PLANE_FIELDS = (
    "income", "hours", "landings", "broken", "crew", "job_hours", "job_done", "job_cost", "mission_hours",
    "mission_done",
)  # fmt: skip
CREW_FIELDS = ("plane", "job_hours", "job_done")

frail_types = st.lists(
    st.builds(
        AircraftType,
        name=st.sampled_from(["frail", "weak"]),
        scales=st.tuples(st.floats(2, 20), st.floats(1, 10)),
        shapes=st.tuples(st.floats(0.8, 6), st.floats(0.8, 6)),
        hour_norm=st.floats(1, 20),
        usage=st.floats(0.2, 1),
        income=st.just((1.0, 20.0)),
    ),
    min_size=1,
    max_size=2,
    unique_by=lambda kind: kind.name,
).map(tuple)


@st.composite
def instances(draw: st.DrawFn) -> AirmeInstance:
    types = draw(st.just(PUBLISHED_TYPES) | frail_types)
    n = draw(st.integers(1, 6))

    def column(values: st.SearchStrategy) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=n, max_size=n)))

    return AirmeInstance(
        n_crews=draw(st.integers(1, 4)),
        kind=column(st.integers(0, len(types) - 1)),
        income=column(st.floats(0.5, 20)),
        hours=column(st.integers(0, 400)),
        landings=column(st.integers(0, 30)),
        broken=column(st.booleans()),
        types=types,
    )


def assert_same_state(simulator: AirmeSimulator, world: World) -> None:
    planes, crews = simulator.state.planes[0], simulator.state.crews[0]
    for slot, plane in world.planes.items():
        assert {k: planes[k][slot].item() for k in PLANE_FIELDS} == {k: plane[k] for k in PLANE_FIELDS}, slot
    for crew, record in world.crews.items():
        assert {k: crews[k][crew].item() for k in CREW_FIELDS} == {k: record[k] for k in CREW_FIELDS}, crew


def accepted(choices: np.ndarray, world: World) -> dict[int, int]:
    """What of the crews' choices is possible: free crews, existing planes that nobody has in hand or chose."""
    decisions: dict[int, int] = {}
    for crew, slot in enumerate(choices):
        free = world.crews[crew]["plane"] == 0
        if free and slot in world.planes and world.planes[slot]["crew"] < 0 and slot not in decisions.values():
            decisions[crew] = int(slot)
    return decisions


@settings(deadline=None, max_examples=60)
@given(
    instance=instances(),
    seed=st.integers(0, 2**63 - 1),
    episode=st.integers(0, 2**63 - 1),
    hours=st.integers(1, 60),
    eagerness=st.floats(0, 1),
    decisions=st.integers(0, 2**32 - 1),
    model=st.sampled_from(["density", "hazard"]),
)
def test_simulator_is_the_reference_to_the_last_bit(
    instance: AirmeInstance, seed: int, episode: int, hours: int, eagerness: float, decisions: int, model: str
) -> None:
    simulator = AirmeSimulator([instance], horizon=hours, failure=model)
    simulator.reset(seed=seed, episodes=[episode])
    world = World(instance, seed, episode, model)
    rng = np.random.default_rng(decisions)
    for hour in range(hours):
        choices = rng.integers(0, instance.n_planes + 1, instance.n_crews)
        choices *= rng.random(instance.n_crews) < eagerness
        expected = world.hour(accepted(choices, world))
        simulator.play_hour(choices[None])
        assert tuple(simulator.state.series[0, hour]) == expected
        assert simulator.reward[0] == expected[0]
        assert_same_state(simulator, world)


def test_a_month_of_a_small_instance_is_the_reference_to_the_last_bit() -> None:
    instance = generate("small", np.random.default_rng(5))
    simulator, world = AirmeSimulator([instance], seed=9), World(instance, seed=9)
    rng = np.random.default_rng(6)
    sums = np.zeros(3)
    for _ in range(720):
        choices = rng.integers(0, instance.n_planes + 1, instance.n_crews) * (rng.random(instance.n_crews) < 0.5)
        sums += world.hour(accepted(choices, world))
        simulator.play_hour(choices[None])
        assert_same_state(simulator, world)
    assert [simulator.objectives()[k][0] for k in ("profit", "revenue", "availability")] == list(sums / 720)


def test_split_mix_is_the_published_one() -> None:
    # The first outputs of SplitMix64 seeded with 1234567 (as in Vigna's splitmix64.c): the finaliser of a counter.
    state, outputs = 1234567, []
    for _ in range(3):
        state = (state + 0x9E3779B97F4A7C15) & (2**64 - 1)
        outputs.append(split_mix(state))
    assert outputs == [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert int(np.uint64(noise.mix(np.uint64(0x9E3779B97F4A7C15 + 1234567)))) == outputs[0]
    assert absorb(0, 0) == split_mix(0x9E3779B97F4A7C15)

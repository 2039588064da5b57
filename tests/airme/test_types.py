"""Aircraft types are known by their names, any number of them, wherever they stand in a fleet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.agents.registry import load_policy
from marl_sched.envs.airme.aircraft import FIXED_WING, HELICOPTER, AircraftType
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator, fleet_types
from marl_sched.errors import InvalidOptionError

DRONE = AircraftType(name="drone", scales=(9.0,), shapes=(3.0,), hour_norm=10.0, usage=0.5, income=(10.0, 10.0))


def fleet(*types: AircraftType, n_crews: int = 2) -> AirmeInstance:
    """Two planes of each type, worn and all earning the same."""
    kind = np.repeat(np.arange(len(types)), 2)
    ones = np.ones(len(kind))
    return AirmeInstance(
        n_crews=n_crews, kind=kind, income=10 * ones, hours=50 * ones, landings=6 * ones, broken=ones < 0, types=types
    )


def reversed_types(instance: AirmeInstance) -> AirmeInstance:
    """The same fleet with its types in the opposite order."""
    return replace(instance, kind=len(instance.types) - 1 - instance.kind, types=instance.types[::-1])


def choices(name: str, instance: AirmeInstance) -> list[int]:
    """What the crews choose in hour 0."""
    simulator = AirmeSimulator([instance])
    scheduler = RULES[name]() if name in RULES else load_policy(name)
    scheduler.start(simulator, np.ones(1, bool))
    chosen: list[int] = []
    while simulator.time[0] == 0:
        chosen.append(int(scheduler.decide(simulator)[0]))
        simulator.step(np.array(chosen[-1:]))
    return chosen


@pytest.mark.parametrize("name", ["preventive-first", "model-based", "index", "airme-full-profit"])
def test_the_order_of_types_in_a_fleet_changes_no_choice(name: str) -> None:
    instance = generate("small", np.random.default_rng(4))
    expected = choices(name, instance)
    assert any(expected)
    assert choices(name, reversed_types(instance)) == expected


def test_published_types_come_first_and_others_by_name() -> None:
    assert fleet_types([fleet(HELICOPTER, FIXED_WING)]) == (FIXED_WING, HELICOPTER)
    assert fleet_types([fleet(HELICOPTER)]) == (FIXED_WING, HELICOPTER)
    assert fleet_types([fleet(DRONE), fleet(HELICOPTER)]) == (FIXED_WING, HELICOPTER, DRONE)
    assert fleet_types([fleet(replace(DRONE, name="b"), replace(DRONE, name="a"))])[0].name == "a"
    assert fleet_types([fleet(DRONE)]) == (DRONE,)


@pytest.mark.parametrize("types", [(FIXED_WING,), (HELICOPTER,)])
def test_a_policy_plays_a_fleet_of_one_published_type(types: tuple[AircraftType, ...]) -> None:
    instance = fleet(*types)
    both = replace(instance, types=(FIXED_WING, HELICOPTER), kind=np.full(2, int(types[0] is HELICOPTER)))
    assert choices("airme-full-profit", instance) == choices("airme-full-profit", both)


def test_fleets_of_different_types_play_in_one_batch_as_they_do_alone() -> None:
    fleets = [fleet(DRONE), fleet(HELICOPTER, FIXED_WING), generate("small", np.random.default_rng(0))]
    batch = AirmeSimulator(fleets, horizon=30, seed=5)
    player = RULES["condition"]().epoch_player(batch)
    assert player is not None
    player(1000)
    for row, one in enumerate(fleets):
        alone = AirmeSimulator([one], horizon=30, seed=5)
        player = RULES["condition"]().epoch_player(alone)
        assert player is not None
        player(1000)
        np.testing.assert_array_equal(batch.state.series[row], alone.state.series[0])


def test_one_name_for_two_types_is_refused_and_so_is_a_type_that_comes_later() -> None:
    with pytest.raises(InvalidOptionError, match=r"instances\[1\]: aircraft type 'drone' is another one elsewhere"):
        AirmeSimulator([fleet(DRONE), fleet(replace(DRONE, usage=0.1))])
    simulator = AirmeSimulator([fleet(FIXED_WING)])
    with pytest.raises(InvalidOptionError, match=r"expected aircraft types of fixed_wing, helicopter .* got drone"):
        simulator.reset(instances=[fleet(DRONE)])


@pytest.mark.parametrize("name", ["index", "index-without-clock"])
def test_the_index_plans_for_a_type_whose_planes_all_earn_the_same(name: str) -> None:
    assert all(0 <= plane <= 2 for plane in choices(name, fleet(DRONE)))


@pytest.mark.parametrize("policy", ["airme-local-profit", "airme-full-profit"])
def test_no_plane_stays_broken_beside_a_crew_with_nothing_to_do(policy: str) -> None:
    """Two new planes, both broken, one crew: a repair takes at most 20 hours, so two of them at most 40."""
    instance = AirmeInstance(n_crews=1, kind=[0, 1], income=[5, 5], hours=[0, 0], landings=[0, 0], broken=[1, 1])
    scheduler = load_policy(policy)
    simulator = AirmeSimulator([instance], horizon=60, seed=1)
    repaired: set[int] = set()
    while not simulator.over[0]:
        action = int(scheduler.decide(simulator)[0])
        if simulator.time[0] <= 40 and action and simulator.state.planes["broken"][0, action]:
            repaired.add(action)
        simulator.step(np.array([action]))
    assert repaired == {1, 2}

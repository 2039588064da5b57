"""Twenty-four hours of a fleet of three, worked out by hand.

Slot  type     usage  fails            income  hours  landings  broken
1     steady   1      never              10      24      5        no
2     fragile  1      at 9 hours          8       7      0        no
3     coin     0.5    never               4      30     12        yes        total income 22, two crews

Draws (seed 138545). A mission is 5 + floor(6u) hours long, a repair 2 + floor(7u) plus its extras, its
one-time cost (0.1 + 0.9u) x income.

Hour 0   Crew 0 goes to broken plane 3: 2 + floor(7 x 0.176) = 3, + floor(30/24) = 1, + floor(12/6) = 2, + 12
         make 18 hours, 0..17. Cost (0.1 + 0.9 x 0.38443) x 4 + 48 + 2 x 18 = 85.783937, 4.765774 an hour.
         Planes 1 and 2 start missions of 5 + floor(6 x 0.949) = 10 and 5 + floor(6 x 0.055) = 5 hours.
Hour 2   Plane 2 has 9 hours on the clock and fails in its third hour: no income, the mission is over, the
         counters stay at 9 hours and 0 landings.
Hour 3   Crew 1 recalls plane 1, which is at 24 + 3 = 27 hours and still at 5 landings (a landing more would
         make 6 and cost another hour): 2 + floor(7 x 0.188) = 3, + floor(27/24) = 1, + 0 make 4 hours, 3..6.
         Cost (0.1 + 0.9 x 0.14400) x 10 + 2 x 4 = 10.296001, 2.574000 an hour.
Hour 7   Plane 1, new again, starts a mission of 5 + floor(6 x 0.628) = 8 hours, 7..14. Crew 1 goes to plane 2:
         2 + floor(7 x 0.162) = 3, + 0 + 0 + 12 make 15 hours, 7..21.
         Cost (0.1 + 0.9 x 0.93114) x 8 + 48 + 2 x 15 = 85.504216, 5.700281 an hour.
Hour 15  Plane 1 has landed once and starts again: 5 + floor(6 x 0.082) = 5 hours, 15..19.
Hour 18  Plane 3 is back, but stays on the ground in hours 18 and 19 (0.925 and 0.874 are not below 0.5).
Hour 20  Plane 3 flies (0.298): 5 + floor(6 x 0.284) = 6 hours. Plane 1, landed twice, starts again (5 hours).
Hour 22  Plane 2 is back and starts a mission of 5 + floor(6 x 0.135) = 5 hours. Crew 0 recalls plane 1, at
         15 hours (7..21) and 2 landings: 2 + floor(7 x 0.348) = 4 hours, of which the episode holds two.
         Cost (0.1 + 0.9 x 0.63505) x 10 + 2 x 4 = 14.715461, 3.678865 an hour.
Hour 24  The end.
"""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched import noise
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.state import BROKEN, FLYING, GROUNDED, REPAIR
from tests.airme.fleets import STEADY, aircraft, fleet, plane

FRAGILE = aircraft("fragile", usage=1.0, fails_at_hours=9)
COIN = aircraft("coin", usage=0.5)
FLEET = fleet((STEADY, 10.0, 24, 5, False), (FRAGILE, 8.0, 7, 0, False), (COIN, 4.0, 30, 12, True), n_crews=2)
SEED, HOURS = 138545, 24

# (stream, hour, slot): the uniforms quoted above.
DRAWS = {
    (16, 0, 3): 0.17624270969366707,
    (17, 0, 3): 0.3844269081754921,
    (19, 0, 1): 0.9486908536245912,
    (19, 0, 2): 0.05527041639971875,
    (16, 3, 1): 0.1882894292995977,
    (17, 3, 1): 0.1440001277282793,
    (19, 7, 1): 0.627719725474813,
    (16, 7, 2): 0.16198495157599713,
    (17, 7, 2): 0.9311411045525426,
    (19, 15, 1): 0.08215745783490636,
    (18, 18, 3): 0.9254011638354568,
    (18, 19, 3): 0.8739778020099424,
    (18, 20, 3): 0.2978251808384964,
    (19, 20, 3): 0.2839639929675444,
    (19, 20, 1): 0.029528813768078255,
    (19, 22, 2): 0.1349305540384388,
    (16, 22, 1): 0.3480398296194106,
    (17, 22, 1): 0.6350511901488648,
}

# (hour, crew, slot) in turn order; hours 4 to 6 and 8 to 17 pass without a free crew.
TURNS = [
    (0, 0, 3), (0, 1, 0), (1, 1, 0), (2, 1, 0), (3, 1, 1), (7, 1, 2), (18, 0, 0), (19, 0, 0), (20, 0, 0), (21, 0, 0),
    (22, 0, 1), (22, 1, 0), (23, 1, 0),
]  # fmt: skip

COST_3, COST_1, COST_2, COST_1_AGAIN = 4.7657742705240, 2.5740002873886, 5.7002810635186, 3.6788651778350
INCOME = [18, 18, 10, 0, 0, 0, 0] + [10] * 13 + [14, 14, 12, 12]
COST = (
    [COST_3] * 3
    + [COST_3 + COST_1] * 4
    + [COST_3 + COST_2] * 11
    + [COST_2] * 4
    + [COST_1_AGAIN] * 2
)  # fmt: skip
AVAILABLE = [2, 2, 1, 0, 0, 0, 0] + [1] * 11 + [2] * 6

F, G, B, R = FLYING, GROUNDED, BROKEN, REPAIR
STATUS = [
    [F] * 3 + [R] * 4 + [F] * 15 + [R] * 2,
    [F] * 2 + [B] * 5 + [R] * 15 + [F] * 2,
    [R] * 18 + [G] * 2 + [F] * 4,
]


@pytest.fixture
def episode() -> AirmeSimulator:
    return AirmeSimulator([FLEET], horizon=HOURS, seed=SEED, record_timeline=True)


def take_turns(simulator: AirmeSimulator, until_hour: int = HOURS) -> None:
    for hour, crew, slot in TURNS:
        if hour >= until_hour:
            return
        assert (simulator.time[0], simulator.acting[0]) == (hour, crew)
        simulator.step(np.array([slot]))


def test_quoted_uniforms_are_the_simulators() -> None:
    episode_key = noise.episode_key(np.uint64(SEED), np.uint64(FLEET.identity), np.uint64(0))
    for (stream, hour, slot), expected in DRAWS.items():
        time_word = np.uint64(noise.time_key(np.uint64(episode_key), hour))
        assert noise.uniform(time_word, stream, slot, 0) == expected


def test_books_of_every_hour(episode: AirmeSimulator) -> None:
    take_turns(episode)
    profit, revenue, availability = episode.state.series[0].T
    np.testing.assert_allclose(revenue, np.array(INCOME) / 22, rtol=1e-12)
    np.testing.assert_allclose(profit, (np.array(INCOME) - COST) / 22, rtol=1e-11)
    np.testing.assert_allclose(availability, np.array(AVAILABLE) / 3, rtol=1e-12)
    assert episode.truncated[0]
    assert not episode.terminated[0]
    assert episode.acting[0] == -1


def test_what_every_plane_does_in_every_hour(episode: AirmeSimulator) -> None:
    take_turns(episode)
    np.testing.assert_array_equal(episode.state.timeline[0, :, 1:].T, STATUS)


def test_a_step_pays_for_the_hours_that_it_lets_pass(episode: AirmeSimulator) -> None:
    profit = (np.array(INCOME) - COST) / 22
    paid = []
    for _, _, slot in TURNS:
        episode.step(np.array([slot]))
        paid.append((int(episode.elapsed[0]), float(episode.reward[0])))
    hours = [0, 1, 1, 1, 4, 11, 1, 1, 1, 1, 0, 1, 1]
    assert [elapsed for elapsed, _ in paid] == hours
    ends = np.cumsum(hours)
    expected = [profit[end - elapsed : end].sum() for end, elapsed in zip(ends, hours, strict=True)]
    np.testing.assert_allclose([reward for _, reward in paid], expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("before_hour", "slot", "expected"),
    [
        (3, 1, {"hours": 27, "landings": 5, "mission_hours": 10, "mission_done": 3, "broken": False}),
        (3, 2, {"hours": 9, "landings": 0, "mission_hours": 0, "mission_done": 0, "broken": True}),
        (3, 3, {"hours": 30, "landings": 12, "job_hours": 18, "job_done": 3, "broken": True, "crew": 0}),
        (7, 1, {"hours": 0, "landings": 0, "mission_hours": 0, "job_hours": 0, "job_cost": 0.0, "crew": -1}),
        (7, 2, {"hours": 9, "landings": 0, "broken": True, "crew": -1}),
        (18, 1, {"hours": 11, "landings": 1, "mission_hours": 5, "mission_done": 3}),
        (18, 2, {"hours": 9, "job_hours": 15, "job_done": 11, "broken": True, "crew": 1}),
        (18, 3, {"hours": 0, "landings": 0, "broken": False, "crew": -1}),
        (22, 1, {"hours": 15, "landings": 2, "mission_hours": 5, "mission_done": 2}),
        (22, 2, {"hours": 0, "landings": 0, "broken": False, "crew": -1}),
        (22, 3, {"hours": 2, "landings": 0, "mission_hours": 6, "mission_done": 2}),
        (24, 1, {"hours": 15, "landings": 2, "mission_hours": 0, "job_hours": 4, "job_done": 2, "crew": 0}),
        (24, 2, {"hours": 2, "landings": 0, "mission_hours": 5, "mission_done": 2}),
        (24, 3, {"hours": 4, "mission_hours": 6, "mission_done": 4}),
    ],
)
def test_a_plane_at_the_start_of_an_hour(
    episode: AirmeSimulator, before_hour: int, slot: int, expected: dict[str, float]
) -> None:
    take_turns(episode, until_hour=before_hour)
    assert episode.time[0] == before_hour
    found = plane(episode, slot)
    assert {name: found[name] for name in expected} == expected

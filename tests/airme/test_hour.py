"""What an hour does and does not do, on fleets whose noise is known beforehand."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError
from tests.airme.fleets import RESERVE, STEADY, aircraft, fleet, plane, play

FAILS_AT_60 = aircraft("fails_at_60", usage=1.0, fails_at_hours=60)
FAILS_AT_4_LANDINGS = aircraft("fails_at_4_landings", usage=1.0, fails_at_landings=4)


def test_failed_plane_earns_nothing_is_not_available_and_its_counters_stand_still() -> None:
    simulator = AirmeSimulator([fleet((FAILS_AT_60, 10.0, 60, 12, False))], horizon=9)
    play(simulator, [0])
    assert simulator.state.series[0, 0].tolist() == [0.0, 0.0, 0.0]
    play(simulator, [0], [0], [0])
    assert simulator.state.series[0, :4].sum() == 0.0
    after = plane(simulator, 1)
    assert (after["broken"], after["hours"], after["landings"], after["mission_hours"]) == (True, 60, 12, 0)


def test_plane_can_fail_in_the_hour_in_which_its_mission_starts() -> None:
    simulator = AirmeSimulator([fleet((FAILS_AT_4_LANDINGS, 10.0, 0, 4, False))])
    play(simulator, [0])
    assert plane(simulator, 1)["broken"]


def test_grounded_plane_does_not_fail() -> None:
    grounded = aircraft("grounded", usage=0.0, fails_at_landings=4, fails_at_hours=60)
    simulator = AirmeSimulator([fleet((grounded, 10.0, 60, 4, False))])
    play(simulator, *[[0]] * 5)
    assert not plane(simulator, 1)["broken"]


def test_failure_looks_at_counters_as_they_stood_before_the_hour() -> None:
    simulator = AirmeSimulator([fleet((FAILS_AT_60, 10.0, 58, 0, False))])
    play(simulator, [0], [0])
    assert (plane(simulator, 1)["hours"], plane(simulator, 1)["broken"]) == (60, False)
    play(simulator, [0])
    assert (plane(simulator, 1)["hours"], plane(simulator, 1)["broken"]) == (60, True)


@pytest.mark.parametrize("broken", [False, True])
def test_repair_makes_a_plane_new_after_exactly_its_hours(broken: bool) -> None:
    simulator = AirmeSimulator([fleet((RESERVE, 10.0, 47, 11, broken))])
    play(simulator, [1])
    job = plane(simulator, 1)
    # 2 to 8, + floor(47/24) = 1, + floor(11/6) = 1, + 12 if broken.
    assert 4 <= job["job_hours"] - 12 * broken <= 10
    assert (job["job_done"], job["broken"], job["hours"], job["landings"]) == (1, broken, 47, 11)
    play(simulator, *[[0]] * (job["job_hours"] - 2))
    assert plane(simulator, 1)["crew"] == 0
    assert plane(simulator, 1)["broken"] == broken  # it stays broken while it is repaired
    play(simulator, [0])
    after = plane(simulator, 1)
    assert (after["crew"], after["hours"], after["landings"], after["broken"]) == (-1, 0, 0, False)
    assert simulator.state.series[0, : job["job_hours"], 2].tolist() == [0.0] * job["job_hours"]
    play(simulator, [0])
    assert simulator.state.series[0, job["job_hours"], 2] == 1.0


def test_recalled_plane_stops_earning_at_once_and_does_not_land() -> None:
    simulator = AirmeSimulator([fleet((STEADY, 10.0, 0, 0, False))])
    play(simulator, [0])
    assert plane(simulator, 1)["mission_done"] == 1
    play(simulator, [1])
    assert simulator.state.series[0, :2, 1].tolist() == [1.0, 0.0]
    recalled = plane(simulator, 1)
    assert (recalled["mission_hours"], recalled["hours"], recalled["landings"]) == (0, 1, 0)


def test_landing_counts_at_the_end_of_the_missions_last_hour() -> None:
    simulator = AirmeSimulator([fleet((STEADY, 10.0, 0, 0, False))])
    play(simulator, [0])
    length = plane(simulator, 1)["mission_hours"]
    assert 5 <= length <= 10
    play(simulator, *[[0]] * (length - 2))
    assert plane(simulator, 1)["landings"] == 0
    play(simulator, [0])
    assert (plane(simulator, 1)["landings"], plane(simulator, 1)["hours"]) == (1, length)


def test_income_is_shared_by_all_planes_and_cost_is_spread_evenly() -> None:
    simulator = AirmeSimulator([fleet((STEADY, 15.0, 0, 0, False), (RESERVE, 5.0, 0, 0, True))])
    play(simulator, [2])
    job = plane(simulator, 2)
    total = job["job_cost"] * job["job_hours"]
    assert 0.1 * 5 <= total - 48 - 2 * job["job_hours"] <= 5
    play(simulator, *[[0]] * 9)
    series = simulator.state.series[0, :10]
    np.testing.assert_allclose(series[:, 1], 0.75, rtol=1e-15)
    np.testing.assert_allclose(series[:, 0], 0.75 - total / job["job_hours"] / 20, rtol=1e-14)


def test_cost_beyond_the_end_of_the_episode_is_not_charged() -> None:
    simulator = AirmeSimulator([fleet((RESERVE, 5.0, 0, 0, True))], horizon=6)
    play(simulator, [1], *[[0]] * 5)
    job = plane(simulator, 1)
    assert job["job_hours"] > 6
    assert simulator.truncated[0]
    assert simulator.objectives()["profit"][0] == pytest.approx(-job["job_cost"] / 5, rel=1e-14)


def test_objectives_are_means_over_the_hours_played() -> None:
    simulator = AirmeSimulator([fleet((FAILS_AT_60, 10.0, 58, 0, False))], horizon=10)
    play(simulator, [0], [0], [0], [0])
    assert {k: v[0] for k, v in simulator.objectives().items()} == {"profit": 0.5, "revenue": 0.5, "availability": 0.5}


@pytest.mark.parametrize(("objective", "expected"), [("profit", 0), ("revenue", 1), ("availability", 2)])
def test_reward_is_the_hours_objective(objective: str, expected: int) -> None:
    simulator = AirmeSimulator([fleet((STEADY, 15.0, 0, 0, False), (RESERVE, 5.0, 0, 0, True))], objective=objective)
    play(simulator, [2])
    assert simulator.reward[0] == simulator.state.series[0, 0, expected]
    assert len(set(simulator.state.series[0, 0])) == 3


def test_an_hour_fails_no_plane_twice_whatever_else_happens_to_the_fleet() -> None:
    # What happens to plane 1 does not depend on whether a crew goes to plane 2.
    rows = (generate("small", np.random.default_rng(1)), generate("small", np.random.default_rng(1)))
    simulator = AirmeSimulator(rows, horizon=50, seed=4)
    choices = np.zeros((2, simulator.max_agents), np.int64)
    for _ in range(50):
        choices[1, 0] = 2
        simulator.play_hour(choices)
    one, two = simulator.state.planes[:, 1:]["hours"]
    assert (np.delete(one, 1) == np.delete(two, 1)).all()
    assert one[1] != two[1]


class TestEnd:
    BREAKS_SOON = fleet(*[(FAILS_AT_60, 10.0, 60 - k, 0, False) for k in range(5)])

    def test_stop_share_terminates_when_four_of_five_are_broken(self) -> None:
        simulator = AirmeSimulator([self.BREAKS_SOON], horizon=50, stop_share=0.8)
        play(simulator, [0], [0], [0])
        assert not simulator.over[0]
        play(simulator, [0])
        assert (simulator.terminated[0], simulator.truncated[0], simulator.time[0]) == (True, False, 4)
        assert simulator.acting[0] == -1

    def test_without_stop_share_the_episode_runs_to_its_horizon(self) -> None:
        simulator = AirmeSimulator([self.BREAKS_SOON], horizon=8)
        play(simulator, *[[0]] * 8)
        assert (simulator.terminated[0], simulator.truncated[0], simulator.time[0]) == (False, True, 8)

    def test_planes_repaired_for_a_failure_count_as_broken(self) -> None:
        simulator = AirmeSimulator([self.BREAKS_SOON], horizon=50, stop_share=0.8)
        play(simulator, [0], [1], [0], [0])
        assert simulator.terminated[0]

    def test_a_row_that_is_over_stays_as_it_is(self) -> None:
        simulator = AirmeSimulator([self.BREAKS_SOON], horizon=2)
        play(simulator, [0], [0])
        before = simulator.snapshot(0)
        simulator.step(np.array([1]))
        after = simulator.snapshot(0)
        assert (before["planes"] == after["planes"]).all()
        assert after["rows"]["reward"] == after["rows"]["elapsed"] == 0


class TestTurns:
    """Who acts when, under the schemes of section 6.3.1."""

    FLEET = fleet(*[(RESERVE, 10.0, 0, 0, True)] * 4, n_crews=3)

    @staticmethod
    def turns(simulator: AirmeSimulator, *actions: int) -> list[tuple[int, int]]:
        seen = []
        for action in actions:
            seen.append((int(simulator.time[0]), int(simulator.acting[0])))
            simulator.step(np.array([action]))
        return seen

    def test_full_asks_every_free_crew_in_ascending_order(self) -> None:
        simulator = AirmeSimulator([self.FLEET])
        assert self.turns(simulator, 0, 2, 0, 0, 0) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)]

    def test_skip_ends_the_hours_decisions_at_the_first_null_plane(self) -> None:
        simulator = AirmeSimulator([self.FLEET], scheme="skip")
        assert self.turns(simulator, 1, 0, 2, 0, 0) == [(0, 0), (0, 1), (1, 1), (1, 2), (2, 2)]

    def test_single_allows_one_decision_an_hour(self) -> None:
        simulator = AirmeSimulator([self.FLEET], scheme="single")
        assert self.turns(simulator, 1, 2, 0, 0) == [(0, 0), (1, 1), (2, 2), (3, 2)]

    def test_hours_without_a_free_crew_pass_in_one_step(self) -> None:
        simulator = AirmeSimulator([fleet((RESERVE, 10.0, 0, 0, False))])
        simulator.step(np.array([1]))
        assert simulator.elapsed[0] == simulator.time[0]
        assert 2 <= simulator.time[0] <= 8

    def test_plane_already_chosen_or_in_repair_idles_the_crew(self) -> None:
        simulator = AirmeSimulator([self.FLEET])
        simulator.step(np.array([1]))
        simulator.step(np.array([1]))
        assert simulator.conflict[0]
        simulator.step(np.array([0]))
        assert not simulator.conflict[0]
        assert (simulator.time[0], simulator.acting[0]) == (1, 1)
        simulator.step(np.array([1]))
        assert simulator.conflict[0]
        assert simulator.snapshot(0)["crews"]["plane"].tolist() == [1, 0, 0]

    def test_action_outside_the_space_raises(self) -> None:
        simulator = AirmeSimulator([self.FLEET])
        for action in (-1, 5):
            with pytest.raises(IllegalActionError, match=rf"action {action}: expected a plane's slot in \[0, 4\]"):
                simulator.step(np.array([action]))
        with pytest.raises(IllegalActionError, match="expected shape"):
            simulator.step(np.array([0, 0]))


class TestReset:
    def test_without_a_seed_the_next_episode_starts_and_with_one_the_first_again(self) -> None:
        simulator = AirmeSimulator([generate("small", np.random.default_rng(0))], horizon=30)
        traces = []
        for seed in (1, None, None, 1):
            simulator.reset(seed=seed)
            play(simulator, *[[0] * simulator.max_agents] * 30)
            traces.append(simulator.state.series[0].copy())
        assert (traces[0] == traces[3]).all()
        assert (traces[0] != traces[1]).any()
        assert (traces[1] != traces[2]).any()

    def test_resetting_some_rows_leaves_the_others_alone(self) -> None:
        instances = [generate("small", np.random.default_rng(i)) for i in range(3)]
        simulator = AirmeSimulator(instances, horizon=30, pad="small")
        simulator.step(np.array([1, 2, 3]))
        before = [simulator.snapshot(b) for b in range(3)]
        simulator.reset(np.array([False, True, False]), instances=[instances[0]], episodes=[7])
        for b in (0, 2):
            assert (simulator.snapshot(b)["crews"] == before[b]["crews"]).all()
        assert simulator.time[1] == 0
        assert simulator.instances[1] is instances[0]

    def test_rows_of_a_batch_are_as_they_are_alone(self) -> None:
        instances = [generate(scale, np.random.default_rng(i)) for i, scale in enumerate(["small", "large", "small"])]
        batch = AirmeSimulator(instances, horizon=40, seed=3)
        rng = np.random.default_rng(0)
        choices = rng.integers(0, 25, (40, 3, batch.max_agents))
        for hour in choices:
            batch.play_hour(hour)
        for b, instance in enumerate(instances):
            alone = AirmeSimulator([instance], horizon=40, seed=3)
            for hour in choices:
                alone.play_hour(hour[b : b + 1, : instance.n_crews])
            assert (alone.state.series[0] == batch.state.series[b]).all()

    def test_instances_fit_the_padding(self) -> None:
        small, large = (generate(scale, np.random.default_rng(0)) for scale in ("small", "large"))
        with pytest.raises(InvalidOptionError, match="exceed the padding"):
            AirmeSimulator([large], pad="small")
        with pytest.raises(InvalidOptionError, match="episodes: expected one per chosen row"):
            AirmeSimulator([small]).reset(episodes=[0, 1])

    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            ({"objective": "proft"}, UnknownNameError, "did you mean 'profit'"),
            ({"scheme": "none"}, UnknownNameError, "unknown scheme"),
            ({"pad": "tiny"}, UnknownNameError, "unknown scale"),
            ({"horizon": 0}, InvalidOptionError, "horizon"),
            ({"stop_share": 1.2}, InvalidOptionError, "stop_share"),
            ({"failure": "bathtub"}, InvalidOptionError, "failure"),
            ({"horizont": 10}, TypeError, "horizont"),
        ],
    )
    def test_bad_option_raises(self, options: dict[str, object], error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            AirmeSimulator([fleet((STEADY, 1.0, 0, 0, False))], **options)

    def test_no_instances_raise(self) -> None:
        with pytest.raises(InvalidOptionError, match="instances: expected at least one"):
            AirmeSimulator([])


def test_published_types_are_those_of_table_6_1() -> None:
    fixed_wing, helicopter = PUBLISHED_TYPES
    assert (fixed_wing.scales, fixed_wing.shapes) == ((15, 12, 18, 16), (5.0, 5.5, 6.0, 6.5))
    assert (helicopter.scales, helicopter.shapes) == ((8, 7, 5), (7, 6, 11))
    assert (fixed_wing.hour_norm, helicopter.hour_norm, fixed_wing.usage, helicopter.usage) == (20, 15, 0.6, 0.3)
    assert (fixed_wing.income, helicopter.income) == ((1, 20), (1, 10))


def test_an_instance_without_planes_raises() -> None:
    with pytest.raises(InvalidOptionError, match="planes: expected 1 to 10000, got 0"):
        AirmeInstance(n_crews=1, kind=[], income=[], hours=[], landings=[], broken=[])


def test_an_instance_whose_types_share_a_name_raises() -> None:
    twins = (PUBLISHED_TYPES[0], PUBLISHED_TYPES[0])
    with pytest.raises(
        InvalidOptionError, match=r"types: expected names that differ, got \['fixed_wing', 'fixed_wing'\]"
    ):
        AirmeInstance(n_crews=1, kind=[1], income=[1], hours=[0], landings=[0], broken=[False], types=twins)

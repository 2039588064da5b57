"""Weibull parameters from records: recovered, as the literature has them, and what the simulator makes of them."""

import json

import numpy as np
import pytest

from marl_sched.domain import get_domain
from marl_sched.envs.airme.aircraft import AircraftType
from marl_sched.envs.airme.fitting import RECORDS, Records, fit_weibull, profile_intervals
from marl_sched.envs.airme.instance import AirmeInstance
from marl_sched.envs.airme.type_files import NO_LANDINGS_PART, read_types
from marl_sched.errors import InvalidSheetError
from marl_sched.sheet_reading import read_sheet

NONE = np.zeros((0, 2))


def draw(seed, n, scale, shape, share):
    """`n` parts, running on where they outlive the usage at which `share` of all have failed."""
    life = scale * np.random.default_rng(seed).weibull(shape, n)
    end = scale * (-np.log(1 - share)) ** (1 / shape)
    return Records(life[life <= end], np.full((life > end).sum(), end), NONE)


@pytest.mark.parametrize(
    ("n", "scale", "shape", "share"), [(40, 240.0, 2.5, 0.7), (150, 15.0, 5.0, 0.9), (300, 8.0, 1.0, 0.4)]
)
def test_known_parameters_lie_within_the_intervals_of_records_drawn_from_them(n, scale, shape, share):
    """Each interval misses 5 of 100 draws: of ten that two miss has a probability of 9 percent, four of 0.1 percent."""
    hits = np.zeros(2)
    for seed in range(10):
        records = draw(seed, n, scale, shape, share)
        intervals = profile_intervals(records, *fit_weibull(records))
        hits += [low <= true <= high for (low, high), true in zip(intervals, (scale, shape), strict=True)]
    assert (hits >= 7).all()


def test_exponential_records_have_the_interval_that_can_be_worked_out():
    """With the shape held at 1 the scale of d failures in time T is T / d, and its profile is that of one parameter.

    The likelihood ratio of scale s is 2 d (log(s d / T) + T / (s d) - 1); here the two-parameter profile is checked at
    its maximum: no other shape is better there, and the score in the scale is 0.
    """
    records = Records(np.array([1.0, 3.0, 5.0, 7.0]), np.array([8.0, 8.0]), NONE)
    scale, shape = fit_weibull(records)
    best = records.log_likelihood(np.log(scale), np.log(shape))
    for step in (-0.02, 0.02):
        assert records.log_likelihood(np.log(scale) + step, np.log(shape)) < best
        assert records.log_likelihood(np.log(scale), np.log(shape) + step) < best
    powers = np.concatenate([records.failed, records.running]) ** shape
    assert scale**shape == pytest.approx(powers.sum() / 4, rel=1e-3)  # the score equation of the scale


def test_failures_found_by_inspection_bound_the_parameters_less_than_those_that_were_seen():
    life = 100 * np.random.default_rng(5).weibull(3.0, 60)
    seen = Records(life, np.zeros(0), NONE)
    found = Records(np.zeros(0), np.zeros(0), np.stack([np.floor(life / 40) * 40 + 1e-9, np.ceil(life / 40) * 40], 1))
    widths = []
    for records in (seen, found):
        (low, high), of_shape = profile_intervals(records, *fit_weibull(records))
        assert low <= 100 <= high
        assert of_shape[0] <= 3.0 <= of_shape[1]
        widths.append(high - low)
    assert widths[0] < widths[1]


def test_an_end_that_two_failures_among_many_running_do_not_bound_is_open():
    records = Records(np.array([10.0, 10.5]), np.zeros(0), NONE)
    _, (low, high) = profile_intervals(records, *fit_weibull(records))
    assert low is not None
    assert high is None or high > 40


def test_the_types_of_a_fit_fly(tmp_path):
    rng = np.random.default_rng(2)
    lines = ["type,part,wears with,usage,state,last running"]
    for part, unit, scale, shape in (("engine", "hours", 200, 2.5), ("gear", "landings", 60, 3)):
        for life in scale * rng.weibull(shape, 40):
            lines.append(f"jet,{part},{unit},{min(life, scale)},{'failed' if life < scale else 'running'},")
    (tmp_path / "records.csv").write_text("\n".join(lines))
    fit = read_sheet(RECORDS, tmp_path / "records.csv", {"landing-hours": "7.5"})
    (tmp_path / "types.json").write_text(json.dumps(fit.as_json()))
    (jet,) = read_types(tmp_path / "types.json")
    engine, gear = fit.parts
    assert jet.parts == ("gear", "engine")
    assert jet.scales[1] == engine.scale
    hazards = [gear.shape / scale**gear.shape for scale in (jet.scales[0], gear.scale)]  # at usage 1, per hour
    assert hazards[0] == pytest.approx(hazards[1] / 7.5)
    assert get_domain("airme").records is not None


def test_parts_that_cannot_be_fitted_are_named(tmp_path):
    path = tmp_path / "records.csv"
    path.write_text(
        "part,wears with,usage,state,last running\na,hours,5,failed,7\na,landings,5,failed,\nb,hours,3,running,2\n"
    )
    with pytest.raises(InvalidSheetError) as refused:
        read_sheet(RECORDS, path)
    assert [line.removeprefix(f"{path}: ") for line in refused.value.lines] == [
        "row 2, column last running: expected less than the usage 5, got 7.0",
        "row 2: expected part a: failures at two different usages at least, got '1 in 2 records'",
        "row 3, column wears with: expected hours, as in row 2, got 'landings'",
        "row 4, column last running: expected nothing, as the part has not failed, got 2.0",
        "row 4: expected part b: failures at two different usages at least, got '0 in 1 records'",
    ]


def test_under_hazard_a_part_that_wears_with_hours_fails_in_the_simulator_as_its_records_say():
    """3,000 planes that nobody repairs: their hours at failure have the mean of Weibull(60, 2.5), 53.2.

    One standard error is 22.7 / sqrt(3,000) = 0.42; whole hours and the five without failures move it by less than 0.6.
    """
    worn = AircraftType(
        name="worn", scales=(NO_LANDINGS_PART[0], 60.0), shapes=(NO_LANDINGS_PART[1], 2.5), hour_norm=1.0, usage=1.0,
        income=(1.0, 1.0),
    )  # fmt: skip
    n = 3000
    zeros = np.zeros(n, int)
    fleet = AirmeInstance(
        n_crews=1, kind=zeros, income=np.ones(n), hours=zeros, landings=zeros, broken=zeros > 0, types=(worn,)
    )
    simulator = get_domain("airme").simulator([fleet], horizon=200, failure="hazard", seed=3)
    while simulator.acting[0] >= 0:
        simulator.step(np.zeros(1, int))
    planes = simulator.state.planes[0, 1:]
    assert planes["broken"].all()
    assert planes["hours"].mean() == pytest.approx(53.2, abs=4 * 0.42 + 0.6)

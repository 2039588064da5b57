"""The failure model: equation 6.1 taken as an hour's probability, and what follows from it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import weibull_min

from marl_sched.envs.airme.aircraft import FIXED_WING, HELICOPTER, PUBLISHED_TYPES, AircraftType, failure_table
from marl_sched.envs.airme.instance import AirmeInstance
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.errors import InvalidOptionError

LONGEST = 900
# Table 6.1, typed from the dissertation: scales, shapes, hour norm.
TABLE_6_1 = {
    "fixed_wing": ([15, 12, 18, 16], [5.0, 5.5, 6.0, 6.5], 20),
    "helicopter": ([8, 7, 5], [7, 6, 11], 15),
}


@pytest.mark.parametrize("model", ["density", "hazard"])
def test_table_is_scipys_weibull(model: str) -> None:
    table = failure_table(PUBLISHED_TYPES, LONGEST, model)
    usage = np.arange(LONGEST + 1)
    for k, kind in enumerate(PUBLISHED_TYPES):
        scales, shapes, norm = TABLE_6_1[kind.name]
        for part, (scale, shape) in enumerate(zip(scales, shapes, strict=True)):
            x, grace = (usage, 0) if part == 0 else (usage / norm, 5)
            law = weibull_min(shape, scale=scale)
            log = law.logpdf(x[1:]) - (law.logsf(x[1:]) if model == "hazard" else 0.0)
            expected = np.concatenate([[0.0], np.exp(np.minimum(log, 0.0))])
            expected[: grace + 1] = 0.0
            np.testing.assert_allclose(table[k, part], expected, rtol=1e-9, atol=1e-300)


def test_first_part_counts_raw_landings_and_cannot_fail_without_any() -> None:
    table = failure_table(PUBLISHED_TYPES, 20)
    assert table[0, 0, 0] == table[1, 0, 0] == 0.0
    # 5/15 (10/15)^4 exp(-(10/15)^5) = 0.33333 x 0.197531 x 0.876615 = 0.057720 for a fixed-wing plane at 10
    # landings, 7/8 (6/8)^6 exp(-(6/8)^7) = 0.875 x 0.177979 x 0.875042 = 0.136271 for a helicopter at 6.
    assert table[0, 0, 10] == pytest.approx(0.0577195, abs=1e-6)
    assert table[1, 0, 6] == pytest.approx(0.136271, abs=1e-6)


def test_parts_that_wear_with_hours_cannot_fail_until_the_sixth() -> None:
    table = failure_table(PUBLISHED_TYPES, 10)
    assert (table[:, 1:, :6] == 0.0).all()
    assert (table[0, 1:, 6:] > 0.0).all()
    assert (table[1, 1:3, 6:] > 0.0).all()


def test_missing_parts_of_a_type_never_fail() -> None:
    assert (failure_table(PUBLISHED_TYPES, LONGEST)[1, 3] == 0.0).all()


def test_density_falls_again_past_its_mode_but_is_not_cut_off() -> None:
    # The helicopter's hours parts peak near 15 x 7 x (5/6)^(1/6) = 102 hours; at 130 they still fail, at 400 hardly.
    part = failure_table([HELICOPTER], LONGEST)[0, 1]
    assert part.argmax() == 102
    assert part[102] > part[130] > 0.0
    assert part[400] < 1e-30


def test_hazard_grows_to_certainty() -> None:
    part = failure_table([FIXED_WING], LONGEST, "hazard")[0, 0]
    assert (np.diff(part) >= 0).all()
    assert part[-1] == 1.0


def test_unknown_failure_model_raises() -> None:
    with pytest.raises(InvalidOptionError, match=r"failure: expected 'density' or 'hazard', got 'weibull'"):
        failure_table(PUBLISHED_TYPES, 10, "weibull")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scales": (1.0,)}, "as many scales as shapes"),
        ({"scales": (), "shapes": ()}, "as many scales as shapes"),
        ({"shapes": (0.0, 1.0)}, "> 0"),
        ({"scales": (float("nan"), 1.0)}, "> 0"),
        ({"hour_norm": float("inf")}, "> 0"),
        ({"usage": 1.5}, "probability, got 1.5"),
        ({"income": (3.0, 2.0)}, "0 < low <= high"),
        ({"income": (1.0, 2.0, 3.0)}, "0 < low <= high"),
    ],
)
def test_impossible_aircraft_type_raises(change: dict[str, object], message: str) -> None:
    good = {"name": "x", "scales": (1.0, 2.0), "shapes": (1.0, 2.0), "hour_norm": 1.0, "usage": 0.5, "income": (1, 2)}
    with pytest.raises(InvalidOptionError, match=message):
        AircraftType(**{**good, **change})


def hours_at_failure_from_new(kind: AircraftType, n_planes: int) -> tuple[np.ndarray, np.ndarray]:
    """(hours, landings) at the first failure of new planes that nobody repairs; -1 for those that never fail."""
    zeros = np.zeros(n_planes, int)
    instance = AirmeInstance(
        n_crews=1, kind=zeros, income=zeros + 1.0, hours=zeros, landings=zeros, broken=zeros > 0, types=(kind,)
    )
    simulator = AirmeSimulator([instance], horizon=720, seed=3)
    while not simulator.over.all():
        simulator.step(np.zeros(1, np.int64))
    planes = simulator.state.planes[0, 1:]
    return np.where(planes["broken"], planes["hours"], -1), planes["landings"]


@pytest.mark.parametrize(("kind", "mean_hours", "landings_share"), [(FIXED_WING, 73, 0.94), (HELICOPTER, 44, 0.78)])
def test_new_planes_fail_after_so_many_hours_and_mostly_of_landings(
    kind: AircraftType, mean_hours: float, landings_share: float
) -> None:
    hours, landings = hours_at_failure_from_new(kind, 4000)
    failed = hours >= 0
    assert failed.mean() > 0.99
    # The spread between planes is below 30 hours, so the mean's standard error below 0.5.
    assert hours[failed].mean() == pytest.approx(mean_hours, abs=1.5)
    # Given that a part failed, the first is to blame with p_0 / (1 - prod(1 - p_k)).
    table = failure_table([kind], 720)[0]
    parts = np.array([table[k, landings if k == 0 else hours] for k in range(len(kind.scales))])[:, failed]
    blame = parts[0] / (1.0 - np.prod(1.0 - parts, axis=0))
    assert blame.mean() == pytest.approx(landings_share, abs=0.015)


def test_planes_far_past_the_mode_fly_on_beyond_400_hours() -> None:
    # A helicopter at 38 landings and 350 hours is past all its modes by a factor of three: it flies for good.
    zeros = np.zeros(5, int)
    instance = AirmeInstance(
        n_crews=1, kind=zeros + 1, income=zeros + 1.0, hours=zeros + 350, landings=zeros + 38, broken=zeros > 0
    )
    simulator = AirmeSimulator([instance], horizon=300)
    while not simulator.over.all():
        simulator.step(np.zeros(1, np.int64))
    planes = simulator.state.planes[0, 1:]
    assert not planes["broken"].any()
    assert (planes["hours"] > 500).all()
    assert simulator.rules.failure.shape[-1] > planes["hours"].max()

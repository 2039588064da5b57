import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from marl_sched.errors import InvalidOptionError
from marl_sched.statistics import (
    holm,
    interquartile_mean,
    paired_difference,
    percent_gain,
    summarise,
)

ONE_TO_EIGHT = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])

scores = arrays(
    np.float64,
    st.tuples(st.integers(1, 6), st.integers(1, 6)),
    elements=st.floats(-1e3, 1e3, allow_subnormal=False),
)


def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def test_summary_of_eight_scores_is_what_the_hand_computes():
    summary = summarise(ONE_TO_EIGHT)
    assert summary.mean == 4.5
    assert summary.std == 2.0  # episode means 2.5 and 6.5
    assert summary.iqm == 4.5  # 3, 4, 5, 6


def test_interquartile_mean_ignores_outliers_on_either_side():
    assert interquartile_mean(np.array([-1e9, 1.0, 2.0, 1e9])) == 1.5


def test_interquartile_mean_leaves_out_whole_scores_only():
    assert interquartile_mean(np.array([0.0, 3.0, 9.0])) == 4.0  # floor(3 / 4) = 0
    assert interquartile_mean(np.array([0.0, 2.0, 4.0, 6.0, 100.0])) == 4.0  # floor(5 / 4) = 1


def test_std_is_over_instances_and_blind_to_episodes():
    noisy = np.array([[0.0, 10.0], [10.0, 0.0]])
    assert summarise(noisy).std == 0.0


def test_summary_becomes_json_with_the_documented_keys():
    data = json.loads(json.dumps(summarise(ONE_TO_EIGHT).as_json()))
    assert list(data) == ["mean", "std", "iqm", "ci95_these_instances", "ci95_such_instances"]


def test_intervals_of_eight_scores_are_what_the_hand_computes():
    """Winsorised at 3 and 6: (3, 3, 3, 4) and (5, 6, 6, 6), each with variance 1/4; half of the scores is kept.

    Within: sqrt((1/4 + 1/4) / 4) / 2 / 0.5 = 0.35355, 0.5 x 2 x 3 = 3 degrees of freedom, t = 3.18245.
    Between: means 3.25 and 5.75, s = 1.76777, / sqrt(2) / 0.5 = 2.5, 1 degree of freedom, t = 12.7062.
    """
    summary = summarise(ONE_TO_EIGHT)
    assert summary.ci95_these_instances == pytest.approx((4.5 - 3.182446 * 0.353553, 4.5 + 3.182446 * 0.353553))
    assert summary.ci95_such_instances == pytest.approx((4.5 - 12.706205 * 2.5, 4.5 + 12.706205 * 2.5))


def test_noise_alone_moves_nothing_where_every_episode_of_an_instance_scores_the_same():
    constant = np.repeat([[0.0], [1.0]], 4, axis=1)
    assert summarise(constant).ci95_these_instances == (0.5, 0.5)


def coverage(instances: int, episodes: int, such: bool, skewed: bool) -> float:
    """Share of 4000 simulated evaluations whose interval holds the truth.

    Instances differ five times as much as episodes do, as AirME's do. The truth is the interquartile mean of infinitely
    many instances, or of infinitely many episodes of the ones that stand for `these`.
    """
    rng = np.random.default_rng(instances * 100 + episodes)

    def draw(count: int) -> np.ndarray:
        return 5.0 * (rng.gamma(8.0, size=(count, 1)) - 8.0) / 8**0.5 if skewed else 5.0 * rng.normal(size=(count, 1))

    effects = draw(200_000 if such else instances)
    truth = interquartile_mean(effects + rng.normal(size=(len(effects), 1 if such else 4000)))
    hits = 0
    for _ in range(4000):
        played = (draw(instances) if such else effects) + rng.normal(size=(instances, episodes))
        summary = summarise(played)
        interval = summary.ci95_such_instances if such else summary.ci95_these_instances
        assert interval is not None
        hits += interval[0] <= truth <= interval[1]
    return hits / 4000


@pytest.mark.slow
@pytest.mark.parametrize("skewed", [False, True])
@pytest.mark.parametrize("such", [False, True])
@pytest.mark.parametrize(("instances", "episodes"), [(100, 2), (40, 4), (25, 10)])
def test_both_kinds_of_interval_cover_93_to_97_percent(instances: int, episodes: int, such: bool, skewed: bool):
    # of 4000 the share of hits has a standard error of 0.34 percent
    assert 0.93 <= coverage(instances, episodes, such, skewed) <= 0.97


def test_one_instance_has_an_interval_over_its_episodes_and_no_other():
    summary = summarise(np.array([[1.0, 2.0, 3.0, 4.0]]))
    assert summary.ci95_such_instances is None
    assert summary.std is None
    assert summary.ci95_these_instances is not None
    assert summary.ci95_these_instances[0] < 2.5 < summary.ci95_these_instances[1]
    alone = summarise(np.array([[1.0]]))
    assert (alone.ci95_these_instances, alone.ci95_such_instances) == (None, None)


def test_holm_corrects_the_smallest_of_three_by_three_and_keeps_the_order():
    # 0.01 x 3, 0.02 x 2, 0.9 x 1; 0.03 is the least that follows 0.03
    assert holm([0.9, 0.01, 0.02]) == pytest.approx([0.9, 0.03, 0.04])
    assert holm([0.04, 0.03]) == pytest.approx([0.06, 0.06])
    assert holm([0.5, 0.6]) == pytest.approx([1.0, 1.0])


@given(scores, st.floats(-100, 100))
def test_adding_a_constant_moves_everything_but_the_spread(values, shift):
    plain = summarise(values)
    moved = summarise(values + shift)
    assert moved.mean == pytest.approx(plain.mean + shift, abs=1e-9)
    assert moved.iqm == pytest.approx(plain.iqm + shift, abs=1e-9)
    assert moved.std == (None if plain.std is None else pytest.approx(plain.std, abs=1e-9))
    for name in ("ci95_these_instances", "ci95_such_instances"):
        before, after = getattr(plain, name), getattr(moved, name)
        if before is not None:
            assert after == pytest.approx([end + shift for end in before], abs=1e-8)


def test_paired_difference_is_the_paired_t_interval():
    rng = np.random.default_rng(11)
    baseline = rng.normal(size=(30, 4))
    better = baseline + 0.1 + 0.2 * rng.normal(size=(30, 4))
    oracle = stats.ttest_rel(better.mean(axis=1), baseline.mean(axis=1))
    difference = paired_difference(better, baseline)
    assert difference.ci95_such_instances == pytest.approx(tuple(oracle.confidence_interval(0.95)))
    assert difference.p == pytest.approx(oracle.pvalue)


def test_paired_difference_of_three_instances_is_what_the_hand_computes():
    difference = paired_difference(
        np.array([[1.0, 3.0], [6.0, 6.0], [0.0, 0.0]]), np.array([[1.0, 1.0], [4.0, 4.0], [-3.0, -3.0]])
    )
    assert difference.mean == 2.0  # differences 1, 2, 3: sample variance 1
    assert difference.std == pytest.approx((2 / 3) ** 0.5)
    assert difference.ci95_such_instances == pytest.approx(
        (2 - 4.302652729911275 / 3**0.5, 2 + 4.302652729911275 / 3**0.5)
    )


def test_a_baseline_does_not_differ_from_itself():
    difference = paired_difference(ONE_TO_EIGHT, ONE_TO_EIGHT)
    assert (difference.mean, difference.std, difference.p) == (0.0, 0.0, 1.0)
    assert difference.ci95_these_instances == difference.ci95_such_instances == (0.0, 0.0)


def test_a_single_pair_says_nothing_about_others():
    data = paired_difference(np.array([[3.0]]), np.array([[1.0]])).as_json()
    assert data == {"mean": 2.0, "std": None, "ci95_these_instances": None, "ci95_such_instances": None, "p": None}


def test_gain_in_percent_is_taken_of_the_instance_mean_of_the_baseline():
    gain = percent_gain(np.array([[3.0, 3.0], [1.0, 2.0]]), np.array([[1.0, 3.0], [1.0, 1.0]]))
    np.testing.assert_array_equal(gain, [[100.0, 0.0], [0.0, 100.0]])
    assert gain.mean(axis=1).tolist() == [50.0, 50.0]  # 100 (3 / 2 - 1) and 100 (1.5 / 1 - 1)


def test_gain_over_a_negative_baseline_is_positive_when_better():
    assert percent_gain(np.array([[-1.0]]), np.array([[-2.0]]))[0, 0] == 50.0


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((0, 2)), np.zeros((2, 0)), np.zeros((1, 1, 1))])
def test_scores_without_instances_and_episodes_are_refused(bad):
    with pytest.raises(InvalidOptionError, match=r"expected shape \(instances, episodes\)"):
        summarise(bad)


def test_score_that_is_not_finite_is_named_and_not_dropped():
    with pytest.raises(InvalidOptionError, match="instance 1, episode 2: expected a finite number, got inf"):
        summarise(np.array([[0.0, 1.0, 2.0], [0.0, 1.0, np.inf]]))


def test_scores_of_other_instances_cannot_be_paired():
    with pytest.raises(InvalidOptionError, match="baseline: expected the scores' shape"):
        paired_difference(np.zeros((2, 3)), np.zeros((3, 2)))


def test_gain_over_a_baseline_of_zero_names_the_instance():
    with pytest.raises(InvalidOptionError, match="instance 1"):
        percent_gain(np.ones((2, 2)), np.array([[1.0, 1.0], [1.0, -1.0]]))

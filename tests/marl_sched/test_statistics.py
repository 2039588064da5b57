import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from marl_sched.errors import InvalidOptionError
from marl_sched.statistics import (
    bootstrap_interval,
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
    summary = summarise(ONE_TO_EIGHT, generator())
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
    assert summarise(noisy, generator()).std == 0.0


def test_summary_becomes_json_with_the_documented_keys():
    data = json.loads(json.dumps(summarise(ONE_TO_EIGHT, generator()).as_json()))
    assert list(data) == ["mean", "std", "iqm", "ci95"]
    low, high = data["ci95"]
    assert low < 4.5 < high


def test_episodes_are_resampled_within_their_own_instance():
    constant = np.repeat([[0.0], [1.0]], 4, axis=1)  # an unstratified bootstrap would mix zeros and ones
    assert bootstrap_interval(constant, generator()) == (0.5, 0.5)


def test_interval_covers_the_true_interquartile_mean_in_about_95_of_100_cases():
    rng = np.random.default_rng(7)
    location = np.linspace(-0.5, 0.5, 5)[:, None]
    hits = 0
    for _ in range(300):
        low, high = bootstrap_interval(location + rng.standard_normal((5, 20)), rng, resamples=400)
        hits += low <= 0.0 <= high
    assert 0.90 <= hits / 300 <= 0.98


def test_single_episodes_are_resampled_over_instances():
    sample = np.random.default_rng(3).gamma(2.0, size=(60, 1))
    oracle = stats.bootstrap(
        (sample[:, 0],),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        method="percentile",
        n_resamples=20_000,
        rng=np.random.default_rng(5),
    ).confidence_interval
    low, high = bootstrap_interval(sample, generator(), resamples=20_000)
    assert low == pytest.approx(oracle.low, abs=0.02)
    assert high == pytest.approx(oracle.high, abs=0.02)


def test_same_generator_gives_the_same_interval_in_chunks_or_at_once(monkeypatch):
    sample = generator().normal(size=(10, 10))
    at_once = bootstrap_interval(sample, generator(), resamples=50)
    monkeypatch.setattr("marl_sched.statistics._CHUNK", 700)
    assert bootstrap_interval(sample, generator(), resamples=50) == at_once


@given(scores)
def test_interval_lies_between_the_extremes(values):
    low, high = bootstrap_interval(values, generator(), resamples=20)
    slack = 1e-9 * (1 + np.abs(values).max())
    assert values.min() - slack <= low <= high <= values.max() + slack


@given(scores, st.floats(-100, 100))
def test_adding_a_constant_moves_everything_but_the_spread(values, shift):
    plain = summarise(values, generator(), resamples=20)
    moved = summarise(values + shift, generator(), resamples=20)
    assert moved.mean == pytest.approx(plain.mean + shift, abs=1e-9)
    assert moved.iqm == pytest.approx(plain.iqm + shift, abs=1e-9)
    assert moved.std == pytest.approx(plain.std, abs=1e-9)
    assert moved.ci95 == pytest.approx([end + shift for end in plain.ci95], abs=1e-9)


def test_paired_difference_is_the_paired_t_interval():
    rng = np.random.default_rng(11)
    baseline = rng.normal(size=(30, 4))
    better = baseline + 0.1 + 0.2 * rng.normal(size=(30, 4))
    oracle = stats.ttest_rel(better.mean(axis=1), baseline.mean(axis=1)).confidence_interval(0.95)
    assert paired_difference(better, baseline).ci95 == pytest.approx(tuple(oracle))


def test_paired_difference_of_three_instances_is_what_the_hand_computes():
    difference = paired_difference(
        np.array([[1.0, 3.0], [6.0, 6.0], [0.0, 0.0]]), np.array([[1.0, 1.0], [4.0, 4.0], [-3.0, -3.0]])
    )
    assert difference.mean == 2.0  # differences 1, 2, 3: sample variance 1
    assert difference.std == pytest.approx((2 / 3) ** 0.5)
    assert difference.ci95 == pytest.approx((2 - 4.302652729911275 / 3**0.5, 2 + 4.302652729911275 / 3**0.5))


def test_a_baseline_does_not_differ_from_itself():
    assert paired_difference(ONE_TO_EIGHT, ONE_TO_EIGHT).as_json() == {"mean": 0.0, "std": 0.0, "ci95": [0.0, 0.0]}


def test_one_instance_has_no_interval_over_instances():
    assert paired_difference(np.array([[3.0]]), np.array([[1.0]])).as_json() == {"mean": 2.0, "std": 0.0, "ci95": None}


def test_gain_in_percent_is_taken_of_the_instance_mean_of_the_baseline():
    gain = percent_gain(np.array([[3.0, 3.0], [1.0, 2.0]]), np.array([[1.0, 3.0], [1.0, 1.0]]))
    np.testing.assert_array_equal(gain, [[100.0, 0.0], [0.0, 100.0]])
    assert gain.mean(axis=1).tolist() == [50.0, 50.0]  # 100 (3 / 2 - 1) and 100 (1.5 / 1 - 1)


def test_gain_over_a_negative_baseline_is_positive_when_better():
    assert percent_gain(np.array([[-1.0]]), np.array([[-2.0]]))[0, 0] == 50.0


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((0, 2)), np.zeros((2, 0)), np.zeros((1, 1, 1))])
def test_scores_without_instances_and_episodes_are_refused(bad):
    with pytest.raises(InvalidOptionError, match=r"expected shape \(instances, episodes\)"):
        summarise(bad, generator())


def test_score_that_is_not_finite_is_named_and_not_dropped():
    with pytest.raises(InvalidOptionError, match="instance 1, episode 2: expected a finite number, got inf"):
        summarise(np.array([[0.0, 1.0, 2.0], [0.0, 1.0, np.inf]]), generator())


def test_scores_of_other_instances_cannot_be_paired():
    with pytest.raises(InvalidOptionError, match="baseline: expected the scores' shape"):
        paired_difference(np.zeros((2, 3)), np.zeros((3, 2)))


def test_gain_over_a_baseline_of_zero_names_the_instance():
    with pytest.raises(InvalidOptionError, match="instance 1"):
        percent_gain(np.ones((2, 2)), np.array([[1.0, 1.0], [1.0, -1.0]]))


def test_no_resamples_is_refused():
    with pytest.raises(InvalidOptionError, match="resamples"):
        bootstrap_interval(ONE_TO_EIGHT, generator(), resamples=0)

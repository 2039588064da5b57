"""Human learning (equation 5.1) and its estimator against sampled humans and against NumPy's linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.envs.murse import estimator
from marl_sched.envs.murse.learning import (
    BETA,
    BETA_STD,
    C_STD,
    EXPONENTIAL,
    K_STD,
    NONE,
    ONE_SHOT,
    C,
    K,
    drawn_duration,
    mean_duration,
    sample_curves,
    whole,
)
from marl_sched.noise import episode_key, time_key

LIMITS = (15, 100)
START = (30.0, 100.0)


def curves(n: int, seed: int = 0) -> np.ndarray:
    return sample_curves(np.random.default_rng(seed), n, START)


def execute(curve: np.ndarray, repetitions: int, entity: int, episode: int = 0) -> int:
    """One stochastic whole duration."""
    time_word = np.uint64(time_key(np.uint64(episode_key(1, 2, episode)), repetitions))
    return whole(drawn_duration(curve, repetitions, EXPONENTIAL, time_word, entity), *LIMITS)


def test_equation_5_1_by_hand():
    curve = np.array([30.0, 0.0, 20.0, 0.0, np.log(2.0), 0.0])
    assert [mean_duration(curve, i, EXPONENTIAL) for i in range(3)] == pytest.approx([50.0, 40.0, 35.0])
    assert [mean_duration(curve, i, ONE_SHOT) for i in range(3)] == [50.0, 30.0, 30.0]
    assert [mean_duration(curve, i, NONE) for i in range(3)] == [50.0, 50.0, 50.0]


def test_durations_fall_by_20_to_40_percent_over_ten_rounds():
    sampled = curves(2000)
    first = np.array([mean_duration(curve, 0, EXPONENTIAL) for curve in sampled])
    tenth = np.array([mean_duration(curve, 9, EXPONENTIAL) for curve in sampled])
    fall = 1.0 - tenth / first
    assert fall.min() >= 0.2 - 1e-12
    assert fall.max() <= 0.4 + 1e-12
    assert fall.mean() == pytest.approx(0.3, abs=0.01)


def test_sampled_curves_keep_the_bounds_of_section_5_7_1():
    sampled = curves(2000)
    start = sampled[:, C] + sampled[:, K]
    assert start.min() >= 30.0
    assert start.max() <= 100.0
    assert sampled[:, [C, K, C_STD, K_STD]].min() >= 1.0 - 1e-9
    assert np.hypot(sampled[:, C_STD], sampled[:, K_STD]).max() <= 28.0
    np.testing.assert_allclose(sampled[:, BETA_STD] * 3.0, sampled[:, BETA])


def test_stochastic_durations_have_the_curves_mean_and_spread():
    curve = np.array([50.0, 3.0, 10.0, 4.0, 0.1, 0.0])
    time_word = np.uint64(time_key(episode_key(0, 0, 0), 0))
    drawn = np.array([drawn_duration(curve, 0, EXPONENTIAL, time_word, entity) for entity in range(20_000)])
    assert drawn.mean() == pytest.approx(60.0, abs=0.15)
    assert drawn.std() == pytest.approx(5.0, abs=0.1)


def test_whole_durations_are_rounded_down_and_clipped():
    assert [whole(y, 15, 100) for y in (44.99, 3.0, -20.0, 250.0)] == [44, 15, 15, 100]


def test_filter_equals_the_textbook_update_in_matrix_form():
    prior = estimator.population_prior(np.random.default_rng(3), START)
    state = estimator.new_filters(prior, (1,))
    mean, covariance = prior.mean.copy(), prior.covariance.copy()
    noise_sum = 3.0 * (prior.c_noise + prior.k_noise)
    for i, observed in enumerate((70.0, 61.0, 58.0)):
        share, beta = np.exp(-np.exp(mean[2]) * i), np.exp(mean[2])
        H = np.array([1.0, share, -mean[1] * beta * i * share])
        ratio = (prior.c_noise + share**2 * prior.k_noise) / (prior.c_noise + prior.k_noise)
        noise = ratio * noise_sum / (5 + i)
        total = H @ covariance @ H + noise
        innovation = observed + 0.5 - mean[0] - mean[1] * share
        gain = covariance @ H / total
        noise_sum += innovation**2 * noise / total / ratio
        mean, covariance = mean + gain * innovation, (np.eye(3) - np.outer(gain, H)) @ covariance
        estimator.update_each(state, np.array([i]), EXPONENTIAL, np.array([observed]))
        np.testing.assert_allclose(state["mean"][0], mean)
        np.testing.assert_allclose(state["covariance"][0], covariance, atol=1e-9)
        assert state["noise_sum"][0] == pytest.approx(noise_sum)


def followed(n: int, population: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether the 95 percent interval covers a fresh draw, and the mean's absolute error: (n, 10) each."""
    sampled = curves(n, seed=population)
    filters = estimator.new_filters(estimator.population_prior(np.random.default_rng([5, population]), START), (n,))
    covered, error = np.empty((n, 10)), np.empty((n, 10))
    for i in range(10):
        repetitions = np.full(n, i)
        low, high = estimator.interval(filters, repetitions, EXPONENTIAL, LIMITS)
        expected, _ = estimator.predict_each(filters, repetitions, EXPONENTIAL)
        truth = np.array([mean_duration(curve, i, EXPONENTIAL) for curve in sampled])
        fresh = np.array([execute(curve, i, j, 2 * population) for j, curve in enumerate(sampled)])
        covered[:, i], error[:, i] = (low <= fresh) & (fresh <= high), np.abs(expected - truth)
        seen = np.array([execute(curve, i, j, 2 * population + 1) for j, curve in enumerate(sampled)], float)
        estimator.update_each(filters, repetitions, EXPONENTIAL, seen)
    return covered, error


def test_interval_covers_fresh_draws_and_the_error_falls_with_repetitions():
    # Twenty problems, each with its own population of 50 as prior, and 50 humans in each.
    runs = [followed(50, population) for population in range(20)]
    covered = np.concatenate([run[0] for run in runs]).mean(axis=0)
    error = np.concatenate([run[1] for run in runs]).mean(axis=0)
    assert 0.93 <= covered[1:].mean() <= 0.97
    assert covered[1:].min() >= 0.93
    assert covered[1:].max() <= 0.97
    assert (np.diff(error) < 0).all()
    assert error[9] < 0.4 * error[0]

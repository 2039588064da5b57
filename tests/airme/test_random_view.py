"""The random view: a local view of its own for every episode."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.envs.airme.instance import generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.views import LocalView, RandomView
from marl_sched.errors import InvalidOptionError
from marl_sched.noise import episode_key


@settings(deadline=None, max_examples=30)
@given(turns=st.integers(0, 150), seed=st.integers(0, 10_000), rows=st.integers(1, 3))
def test_drawn_view_shows_what_the_local_view_with_its_numbers_shows(turns: int, seed: int, rows: int) -> None:
    instances = [generate("small", np.random.default_rng([seed % 5, row])) for row in range(rows)]
    drawn = AirmeSimulator(instances, view=RandomView(staleness_most=8), horizon=200, seed=seed, pad="small")
    reach, comm, staleness = drawn.limits.T.tolist()
    fixed = [
        AirmeSimulator([instance], view=LocalView(reach=r, comm=c, staleness=h), horizon=200, seed=seed, pad="small")
        for instance, r, c, h in zip(instances, reach, comm, staleness, strict=True)
    ]
    rng = np.random.default_rng(seed)
    for _ in range(turns + 1):
        seen = drawn.observe(drawn.acting)
        for row, simulator in enumerate(fixed):
            for name, value in simulator.observe(simulator.acting).items():
                np.testing.assert_array_equal(seen[name][row], value[0], err_msg=name)
        actions = np.array([rng.choice(np.flatnonzero(mask)) if rng.random() < 0.6 else 0 for mask in drawn.legal()])
        drawn.step(actions)
        for simulator, action in zip(fixed, actions, strict=True):
            simulator.step(np.array([action]))


def test_drawn_numbers_cover_their_ranges_evenly_and_leave_the_asked_share_fresh() -> None:
    view = RandomView(reach_most=2, comm_most=1, staleness_most=3, fresh_share=0.25)
    keys = [episode_key(np.uint64(5), np.uint64(7), np.uint64(episode)) for episode in range(4000)]
    reach, comm, staleness = np.array([view.limits_in(np.uint64(key)) for key in keys]).T
    for values, shares in ((reach, [1 / 3] * 3), (comm, [1 / 2] * 2), (staleness, [0.25 + 0.75 / 4, *[0.75 / 4] * 3])):
        # four standard deviations of a share of 4000 are at most 0.032
        np.testing.assert_allclose(np.bincount(values) / 4000, shares, atol=0.032)
    assert abs(np.corrcoef([reach, comm, staleness]) - np.eye(3)).max() < 0.065


def test_every_episode_draws_a_view_of_its_own_that_its_number_and_seed_name() -> None:
    instance = generate("small", np.random.default_rng(0))
    simulator = AirmeSimulator([instance] * 2, view=RandomView(staleness_most=100), seed=3)
    simulator.reset(seed=3, episodes=[0, 5])
    first, sixth = simulator.limits.tolist()
    assert first != sixth
    for _ in range(5):
        simulator.reset(np.array([True, False]))
    assert simulator.limits.tolist() == [sixth, sixth]
    simulator.reset(seed=4, episodes=[0, 5])
    assert simulator.limits.tolist() != [first, sixth]


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan"), True, "half"])
def test_share_of_fresh_episodes_that_is_no_share_raises(share: object) -> None:
    with pytest.raises(InvalidOptionError, match=r"view random: fresh_share: expected a share in \[0, 1\], got "):
        RandomView(fresh_share=share)  # type: ignore[arg-type]


def test_most_of_a_random_view_that_is_negative_raises() -> None:
    with pytest.raises(InvalidOptionError, match=r"view random: comm_most: expected an integer in"):
        RandomView(comm_most=-1)

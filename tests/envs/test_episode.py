"""The ranges of the options that every domain's simulator takes."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.errors import InvalidOptionError

IMPOSSIBLE_SEEDS = [-1, 2**63, 10**30, 1.5, "7", True]


@pytest.mark.parametrize("horizon", [0, -1, 2.5, "3", True, 10**12, pytest.param(10**5000, id="huge")])
def test_horizon_that_no_episode_can_have_is_refused(domain, horizon):
    instances = domain.instances("small", 1, seed=0)
    with pytest.raises(InvalidOptionError, match=r"^horizon: expected an integer in \[1, \d+\] \(\w+\), got .{1,60}$"):
        domain.simulator(instances, horizon=horizon)


@pytest.mark.parametrize("seed", IMPOSSIBLE_SEEDS)
def test_seed_that_no_int64_holds_is_refused(domain, seed):
    with pytest.raises(InvalidOptionError, match="seed: expected an integer in"):
        domain.instances("small", 1, seed=seed)
    instances = domain.instances("small", 1, seed=0)
    with pytest.raises(InvalidOptionError, match="seed: expected an integer in"):
        domain.simulator(instances, seed=seed)
    simulator = domain.simulator(instances, seed=2**63 - 1)
    with pytest.raises(InvalidOptionError, match="seed: expected an integer in"):
        simulator.reset(seed=seed)


def test_seed_and_horizon_of_numpy_are_integers_like_others(domain):
    simulator = domain.simulator(domain.instances("small", 1, seed=np.int64(3)), horizon=np.int32(2), seed=np.uint8(4))
    assert simulator.acting[0] >= 0

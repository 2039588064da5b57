"""The best of a policy's sampled schedules: never worse than the greedy one, and found without what is not known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_sched.agents.murse.sampling import BestOfSamples, copies_of
from marl_sched.agents.networks.hetgat.residual import ResidualHetGATNetwork
from marl_sched.agents.playing import play
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import get_domain
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidOptionError

ROWS = 6


def simulator(**options: object) -> MurseSimulator:
    domain = get_domain("murse")
    return MurseSimulator(domain.instances("small", ROWS, 4), horizon=2, pad="medium", **options)


def policy(made: MurseSimulator) -> NetworkPolicy:
    """One that prefers the rule's choices, but not surely."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = ResidualHetGATNetwork(made.graph, width=4, heads=2)
    return NetworkPolicy(network, domain="murse")


def test_one_sample_is_the_greedy_policy_and_more_are_never_worse_where_durations_are_known():
    made = simulator(durations="deterministic")
    greedy = play(policy(made), made).per_round()["makespan"].copy()
    makespans = []
    for samples in (1, 12):
        sampled = simulator(durations="deterministic")
        makespans.append(play(BestOfSamples(policy(sampled), samples), sampled).per_round()["makespan"][:, 0])
    np.testing.assert_array_equal(makespans[0], greedy[:, 0])
    assert (makespans[1] <= makespans[0]).all()
    assert (makespans[1] < makespans[0]).any()


def test_copies_stand_where_the_row_stands_and_leave_it_alone():
    made = simulator(durations="stochastic")
    started = policy(made)
    while made.progress[1] < 1:
        made.step(started.decide(made))
    before = made.snapshot(1)
    copies = copies_of(made, 1, 3)
    small = made.instances[1].n_tasks
    assert copies.progress.tolist() == [1, 1, 1]
    for name in ("planned", "spread"):
        known = made.state.pairs[name][1, :small, : made.instances[1].n_agents]
        np.testing.assert_array_equal(copies.state.pairs[name], np.stack([known] * 3))
    while copies.progress.min() < 2:
        copies.step(started.decide(copies))
    after = made.snapshot(1)
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_what_is_not_planned_is_refused():
    for options in ({"mode": "online"}, {"view": get_domain("murse").make_view("local")}):
        made = simulator(**options)
        with pytest.raises(InvalidOptionError, match="expected mode plan and the full view"):
            play(BestOfSamples(policy(made), 4), made)
    with pytest.raises(InvalidOptionError, match="samples: expected an integer >= 1, got 0"):
        BestOfSamples(policy(simulator()), 0)

"""A HetGAT that corrects a rule: it starts as the rule, does not care for slots, and needs ranks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_sched.agents.networks.compaction import compacted
from marl_sched.agents.networks.hetgat.residual import ResidualHetGATNetwork
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import get_domain
from marl_sched.envs.airme.features import graph_spec
from marl_sched.envs.murse.graph import RANK, RULE_CHOICE
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator


def simulator(count: int = 4) -> TurnSimulator:
    domain = get_domain("murse")
    return domain.simulator(domain.instances("small", count, 1), horizon=1, pad="medium")


def test_untrained_network_decides_by_the_rule():
    small = simulator()
    policy = NetworkPolicy(ResidualHetGATNetwork(small.graph, width=4, heads=2))
    while not small.over.all():
        chosen = small.observe(small.acting)["task"][..., RULE_CHOICE].argmax(1)
        decided = policy.decide(small)
        np.testing.assert_array_equal(decided, np.where(small.over, 0, chosen))
        small.step(decided)


def test_untrained_logits_fall_with_the_logarithm_of_the_rank():
    small = simulator()
    observation = small.observe(small.acting)
    logits = NetworkPolicy(ResidualHetGATNetwork(small.graph, width=4, heads=2)).logits(observation)
    legal = observation["action_mask"] == 1
    ranks = (10 * observation["task"][..., RANK])[legal]
    np.testing.assert_allclose(logits[legal], -3.0 * np.log1p(ranks), rtol=1e-5, atol=1e-6)


def test_logits_are_the_same_without_the_slots_that_nobody_needs():
    small = simulator()
    with torch.random.fork_rng():
        torch.manual_seed(1)
        network = ResidualHetGATNetwork(small.graph, width=4, heads=2)
        torch.nn.init.normal_(network.correct[-1].weight)
    observation = {name: torch.from_numpy(array) for name, array in small.observe(small.acting).items()}
    smaller, names = compacted(network.spec, observation)
    assert smaller["task"].shape[1] < observation["task"].shape[1]
    expected = network(observation).gather(1, names)
    legal = smaller["action_mask"] == 1
    torch.testing.assert_close(network(smaller)[legal], expected[legal], rtol=1e-4, atol=1e-5)


def test_graph_without_ranks_is_refused():
    with pytest.raises(InvalidOptionError, match="expected a feature 'rank/10' of plane"):
        ResidualHetGATNetwork(graph_spec(2))

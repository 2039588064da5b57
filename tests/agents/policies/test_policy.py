"""A network as a scheduler: how it picks, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from marl_sched.agents.base import inverse_distribution
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import ACTION_MASK, NodeType

SIZES = {"plane": 9, "crew": 4}
LOWEST = np.finfo(np.float32).min


@pytest.fixture
def network(fleet) -> HetGATNetwork:
    torch.manual_seed(0)
    network = HetGATNetwork(fleet)
    torch.nn.init.normal_(network.readout.weight)
    return network


@pytest.fixture
def observation(fleet, observe) -> dict[str, np.ndarray]:
    return {name: values.numpy() for name, values in observe(fleet, SIZES, batch=7).items()}


def row_of(observation, b: int) -> dict[str, np.ndarray]:
    return {name: values[b] for name, values in observation.items()}


def test_greedy_takes_the_most_probable_legal_action(network, observation):
    policy = NetworkPolicy(network)
    actions = policy.choose(observation, np.zeros(7))
    assert actions.dtype == np.int64
    assert (observation[ACTION_MASK][np.arange(7), actions] == 1).all()
    assert (actions == policy.logits(observation).argmax(1)).all()


def test_greedy_ties_go_to_the_lowest_index(network, observation):
    torch.nn.init.zeros_(network.readout.weight)
    assert (NetworkPolicy(network).choose(observation, np.full(7, 0.9)) == 0).all()


def test_sampling_follows_the_distribution(network, observation):
    policy = NetworkPolicy(network, mode="sample")
    count = 20_000
    many = {name: np.repeat(values[:1], count, axis=0) for name, values in observation.items()}
    picks = policy.choose(many, np.random.default_rng(0).random(count))
    probabilities = torch.from_numpy(policy.logits(row_as_batch(observation, 0)))[0].double().softmax(0).numpy()
    legal = probabilities > 0
    assert legal.sum() > 3
    assert probabilities[legal].max() < 0.9
    counts = np.bincount(picks, minlength=SIZES["plane"])
    assert counts[~legal].sum() == 0
    assert chisquare(counts[legal], count * probabilities[legal] / probabilities[legal].sum()).pvalue > 1e-3


def row_as_batch(observation, b: int) -> dict[str, np.ndarray]:
    return {name: values[b : b + 1] for name, values in observation.items()}


def test_sampling_is_a_function_of_observation_and_uniform(network, observation):
    policy, again = NetworkPolicy(network, mode="sample"), NetworkPolicy(network, mode="sample")
    uniform = np.linspace(0.0, 0.999, 7)
    first = policy.choose(observation, uniform)
    torch.rand(5)
    assert (again.choose(observation, uniform) == first).all()


@pytest.mark.parametrize(
    ("uniform", "action"), [(0.0, 1), (0.2499, 1), (0.25, 3), (0.7499, 3), (0.75, 4), (np.nextafter(1.0, 0.0), 4)]
)
def test_inverse_distribution_by_hand(uniform: float, action: int):
    """Probabilities 0, 1/4, 0, 1/2, 1/4 and 0."""
    logits = np.array([[LOWEST, 0.0, LOWEST, np.log(2.0), 0.0, LOWEST]])
    assert inverse_distribution(logits, np.array([uniform])) == [action]


def test_one_agent_chooses_what_it_would_choose_in_a_batch_of_one(network, observation):
    policy = NetworkPolicy(network, mode="sample")
    for b in range(7):
        row = row_of(observation, b)
        mask = row.pop(ACTION_MASK)
        as_pettingzoo = {"observation": row, "action_mask": mask}
        batched = policy.choose(row_as_batch(observation, b), np.array([0.3]))
        assert policy.act(as_pettingzoo, uniform=0.3) == batched[0]
        assert policy.act({**row, ACTION_MASK: mask}, uniform=0.3) == batched[0]


def test_a_single_decision_is_bit_equal_when_it_is_repeated(network, observation):
    policy = NetworkPolicy(network)
    first = policy.logits(row_as_batch(observation, 2))
    for _ in range(20):
        assert (policy.logits(row_as_batch(observation, 2)) == first).all()
    # alone and in a batch the terms of float32 sums may be added in another order: some hundred roundings of 6e-8
    np.testing.assert_allclose(policy.logits(observation)[2], first[0], rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("error")
def test_read_only_arrays_as_a_message_holds_them_are_accepted(network, observation):
    frozen = {name: np.frombuffer(v.tobytes(), v.dtype).reshape(v.shape) for name, v in observation.items()}
    assert not frozen["plane"].flags.writeable
    policy = NetworkPolicy(network)
    assert (policy.choose(frozen, np.zeros(7)) == policy.choose(observation, np.zeros(7))).all()


def test_a_policy_keeps_the_weights_it_was_made_with(network, observation):
    policy = NetworkPolicy(network)
    before = policy.logits(observation)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    assert (policy.logits(observation) == before).all()


def test_an_observation_of_another_graph_is_refused(network, observation):
    observation["plane"] = observation["plane"][..., :-1]
    with pytest.raises(InvalidOptionError, match=r"plane: policy unsaved expects 5 features, got shape \(7, 9, 4\)"):
        NetworkPolicy(network).choose(observation, np.zeros(7))


def test_a_missing_array_is_refused(network, observation):
    del observation["state"]
    with pytest.raises(InvalidOptionError, match="observation: state: policy unsaved expects 4 features"):
        NetworkPolicy(network).choose(observation, np.zeros(7))


def test_an_unknown_mode_is_refused(network):
    with pytest.raises(InvalidOptionError, match="expected one of greedy, sample, one_pass, got 'warm'"):
        NetworkPolicy(network, mode="warm")


def test_rows_that_are_over_get_0_and_change_no_other_choice():
    domain = get_domain("airme")
    simulator = domain.simulator(domain.instances("small", 4, 0), horizon=3, pad="small")
    torch.manual_seed(0)
    policy = NetworkPolicy(HetGATNetwork(simulator.graph), mode="sample")
    while simulator.over.sum() < 2:
        simulator.step(policy.decide(simulator))
    acting = simulator.acting >= 0
    assert acting.any()
    whole = policy.choose(simulator.observe(simulator.acting), simulator.policy_noise(simulator.acting))
    actions = policy.decide(simulator)
    assert (actions[~acting] == 0).all()
    assert (actions[acting] == whole[acting]).all()


def test_a_policy_that_samples_wants_a_uniform_and_a_greedy_one_does_not(network, observation):
    row = row_of(observation, 0)
    with pytest.raises(InvalidOptionError, match=r"unsaved samples: act\(observation, uniform\)"):
        NetworkPolicy(network, mode="sample").act(row)
    assert NetworkPolicy(network).act(row) == NetworkPolicy(network).act(row, uniform=0.9)


def test_in_one_pass_all_crews_of_an_hour_draw_from_what_the_first_of_them_saw():
    domain = get_domain("airme")
    simulator = domain.simulator(domain.instances("small", 5, 3), seed=3, horizon=12)
    torch.manual_seed(0)
    network = HetGATNetwork(simulator.graph, width=4, heads=2, layers=2)
    torch.nn.init.normal_(network.readout.weight, std=5.0)
    policy, plain = NetworkPolicy(network, mode="one_pass"), NetworkPolicy(network, mode="sample")
    first, changed = {}, 0
    for _ in range(2):  # episodes
        policy.start(simulator, np.ones(5, np.bool_))
        first.clear()
        while (simulator.acting >= 0).all():
            observation = simulator.observe(simulator.acting)
            logits, noise = plain.logits(observation), simulator.policy_noise(simulator.acting)
            for b, hour in enumerate(simulator.time):
                kept = first.setdefault((b, int(hour)), logits[b].copy())
                changed += bool(np.abs(kept - logits[b])[observation[ACTION_MASK][b] != 0].max() > 1e-3)
            kept = np.array([first[b, int(hour)] for b, hour in enumerate(simulator.time)])
            expected = inverse_distribution(np.where(observation[ACTION_MASK] != 0, kept, LOWEST), noise)
            actions = policy.decide(simulator)
            assert actions.tolist() == expected.tolist()
            simulator.step(actions)
        simulator.reset()
    assert changed > 20  # logits of later turns would have been others


def test_one_pass_is_refused_where_it_would_show_agents_what_the_first_of_them_sees():
    domain = get_domain("airme")
    simulator = domain.simulator(domain.instances("small", 1, 3), view=domain.view("local"), seed=3, horizon=12)
    policy = NetworkPolicy(HetGATNetwork(simulator.graph, width=4, heads=2, layers=2), mode="one_pass")
    with pytest.raises(InvalidOptionError, match=r"one_pass .* is for the full view; got view local"):
        policy.decide(simulator)


def test_what_is_pressing_is_found_by_the_names_of_features(fleet):
    # Broken and seen as it is: slots 1 and 2, of which 2 is not legal. Slot 3 is broken as it was some hours ago.
    broken, age = np.array([[0, 1, 1, 1, 0]]), np.array([[0, 0, 0, 0.3, 0]])
    pressing = get_domain("airme").pressing
    assert pressing is not None
    for features, columns in ((("broken", "age_hours/10"), (broken, age)), (("age_hours/10", "broken"), (age, broken))):
        spec = replace(fleet, nodes=(NodeType("plane", features), fleet.node("crew")))
        seen = {"plane": np.stack(columns, axis=-1), ACTION_MASK: np.array([[1, 1, 0, 1, 1]])}
        assert pressing(spec, seen).tolist() == [[False, True, False, False, False]]
    without = replace(fleet, nodes=(NodeType("plane", ("broken", "landings")), fleet.node("crew")))
    assert not pressing(without, seen).any()

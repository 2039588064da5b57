"""Decima and DeepRM (dissertation, section 6.5.1) against their equations, worked out node by node."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from marl_sched.agents.networks.decima import DecimaConfig, DecimaNetwork
from marl_sched.agents.networks.deeprm import DeepRMConfig, DeepRMNetwork
from marl_sched.agents.networks.hetgat.network import HetGATConfig, HetGATNetwork
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.registry import config_of_card
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.agents.policies.checkpoint import load_network, save_network
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import domain_names, get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.files import read_json, write_json
from marl_sched.graph import ACTION_MASK, STATE, GraphSpec

LOWEST = np.finfo(np.float32).min
PUBLISHED = {"decima": DecimaNetwork, "deeprm": DeepRMNetwork}


def drawn(network: PolicyNetwork) -> PolicyNetwork:
    """The network with weights of which none is small, so that logits differ by much more than rounding."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.4)
    return network


def made(name: str, graph: GraphSpec, sizes: dict[str, int]) -> PolicyNetwork:
    return drawn(DecimaNetwork(graph, hidden=6) if name == "decima" else DeepRMNetwork(graph, slots=sizes, hidden=6))


def perceptron(network: nn.Module, x: np.ndarray) -> np.ndarray:
    """Fully connected layers in NumPy, from the weights alone: ReLU after all but the last."""
    values = [parameter.detach().numpy().astype(np.float64) for parameter in network.parameters()]
    for i in range(0, len(values), 2):
        x = values[i] @ x + values[i + 1]
        if i + 2 < len(values):
            x = np.maximum(x, 0.0)
    return x


def arrays(observation: dict[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: values.numpy() for name, values in observation.items()}


def test_decima_scores_every_task_as_equations_6_9_and_6_10_say(graph, sizes, observe):
    network, observation = made("decima", graph, sizes), observe(graph, sizes)
    seen, task = arrays(observation), graph.decision_of
    logits = network(observation).detach().numpy()
    for b in range(3):
        visible = np.flatnonzero(seen[f"{task}_mask"][b])
        embedded = {m: perceptron(network.f, seen[task][b, m]) for m in visible}
        state = perceptron(network.g, sum(embedded.values()))
        for m in range(sizes[task]):
            if seen[ACTION_MASK][b, m]:
                score = perceptron(network.q, np.concatenate([embedded[m], state]))
                assert logits[b, m] == pytest.approx(score.item(), rel=1e-4, abs=1e-4)
            else:
                assert logits[b, m] == LOWEST


def test_decima_by_hand(fleet, observe):
    """Networks of one unit that add: f(h) = h_0 + 1, g(x) = 2 x, q(f, s) = 3 f + s, over planes 1, 5 and, hidden, 9."""
    network = DecimaNetwork(fleet, hidden=1)
    values = {"f": ([1, 0, 0, 0, 0], 1), "g": ([2], 0), "q": ([3, 1], 0)}
    with torch.no_grad():
        for name, (weight, bias) in values.items():
            for parameter in (stack := getattr(network, name)).parameters():
                parameter.fill_(1.0 if parameter.dim() == 2 else 0.0)
            stack[0].weight.copy_(torch.tensor([weight], dtype=torch.float32))
            stack[0].bias.fill_(bias)
    observation = observe(fleet, {"plane": 3, "crew": 1}, batch=1)
    observation["plane"][0, :, 0] = torch.tensor([1.0, 5.0, 9.0])
    observation["plane_mask"][0] = torch.tensor([1, 1, 0])
    observation[ACTION_MASK][0] = torch.tensor([1, 1, 0])
    # f: 2 and 6; h_s = 2 * (2 + 6) = 16; q: 3 * 2 + 16 and 3 * 6 + 16
    assert network(observation)[0].tolist() == [22.0, 34.0, LOWEST]


def test_deeprm_reads_all_nodes_and_the_state_as_one_vector(graph, sizes, observe):
    network, observation = made("deeprm", graph, sizes), observe(graph, sizes)
    seen = arrays(observation)
    logits = network(observation).detach().numpy()
    for b in range(3):
        vector = []
        for node in graph.nodes:
            for i in range(sizes[node.name]):
                visible = seen[f"{node.name}_mask"][b, i]
                vector += seen[node.name][b, i].tolist() if visible else [0.0] * len(node.features)
        expected = perceptron(network.stack, np.array(vector + seen[STATE][b].tolist()))
        legal = seen[ACTION_MASK][b] == 1
        assert logits[b, legal] == pytest.approx(expected[legal], rel=1e-4, abs=1e-4)
        assert (logits[b, ~legal] == LOWEST).all()


def test_layers_are_those_of_the_dissertation(fleet):
    def widths(stack: nn.Module) -> list[tuple[int, ...]]:
        return [tuple(parameter.shape) for parameter in stack.parameters() if parameter.dim() == 2]

    decima = DecimaNetwork(fleet)
    assert widths(decima.f) == [(64, 5), (64, 64), (64, 64)]
    assert widths(decima.g) == [(64, 64), (64, 64), (64, 64)]
    assert widths(decima.q) == [(64, 128), (64, 64), (1, 64)]
    deeprm = DeepRMNetwork(fleet, slots={"plane": 9, "crew": 4})
    assert widths(deeprm.stack) == [(64, 9 * 5 + 4 * 3 + 4), (64, 64), (64, 64), (9, 64)]


@pytest.mark.parametrize("name", PUBLISHED)
def test_nan_in_hidden_slots_changes_no_bit(name: str, graph, sizes, observe):
    network, observation = made(name, graph, sizes), observe(graph, sizes, batch=6)
    poisoned = dict(observation)
    for node in graph.nodes:
        hidden = observation[f"{node.name}_mask"] == 0
        assert hidden.any()
        poisoned[node.name] = observation[node.name].masked_fill(hidden[..., None], torch.nan)
    assert torch.equal(network(poisoned), network(observation))
    (network(poisoned) * observation[ACTION_MASK]).sum().backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in network.parameters())


@pytest.mark.parametrize("name", PUBLISHED)
def test_what_is_visible_does_change_logits(name: str, fleet, observe):
    sizes = {"plane": 9, "crew": 4}
    network, observation = made(name, fleet, sizes), observe(fleet, sizes)
    before = network(observation)
    observation["plane"][:, 0] += 1.0
    assert (network(observation) != before)[observation[ACTION_MASK] == 1].all()


def test_permuting_planes_permutes_decimas_decisions_and_empty_slots_change_nothing(fleet, observe):
    network = made("decima", fleet, {}).double()
    observation = observe(fleet, {"plane": 9, "crew": 4})
    observation = {name: v.double() if v.is_floating_point() else v for name, v in observation.items()}
    order = torch.tensor([3, 0, 8, 1, 2, 7, 6, 5, 4])
    permuted, padded = dict(observation), dict(observation)
    for name in ("plane", "plane_mask", ACTION_MASK):
        values = observation[name]
        permuted[name] = values[:, order]
        padded[name] = torch.cat([values, torch.zeros_like(values[:, :5])], dim=1)
    logits = network(observation)
    assert torch.allclose(network(permuted), logits[:, order], rtol=1e-12, atol=1e-12)
    assert torch.allclose(network(padded)[:, :9], logits, rtol=1e-12, atol=1e-12)
    assert (network(padded)[:, 9:] == torch.finfo(torch.float64).min).all()


@pytest.mark.parametrize("sizes", [{"plane": 10, "crew": 4}, {"plane": 9, "crew": 3}])
def test_deeprm_refuses_other_sizes_and_names_both(sizes: dict[str, int], fleet, observe):
    policy = NetworkPolicy(made("deeprm", fleet, {"plane": 9, "crew": 4}))
    message = f"slots 9 plane, 4 crew cannot read one with {sizes['plane']} plane, {sizes['crew']} crew"
    with pytest.raises(InvalidOptionError, match=re.escape(message)):
        policy.choose(arrays(observe(fleet, sizes)), np.zeros(3))


def test_deeprm_for_other_node_types_is_refused(fleet):
    with pytest.raises(InvalidOptionError, match=r"slots: expected a number for each of \['crew', 'plane'\]"):
        DeepRMNetwork(fleet, slots={"plane": 9})


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("domain", domain_names())
def test_a_published_policy_comes_back_from_its_files_and_plays_every_domain(name: str, domain: str, tmp_path):
    known = get_domain(domain)
    simulator = known.simulator(known.instances(next(iter(known.scales)), 2, 0), pad=next(iter(known.scales)))
    slots = {node.name: simulator.arrays[node.name].shape[0] for node in simulator.graph.nodes}
    network = made(name, simulator.graph, slots)
    card = PolicyCard(
        domain=domain, objective=known.objectives[0], view={"kind": "full"}, graph=network.spec, sizes=network.sizes,
        command="none", git_hash="", seed=0, scores={},
    )  # fmt: skip
    path = tmp_path / "mine.safetensors"
    save_network(path, network, card)
    again, read = load_network(path)
    assert type(again) is PUBLISHED[name]
    assert read.sizes == network.sizes
    assert read_json(path.with_suffix(".json"))["sizes"]["architecture"] == name
    policy, loaded = NetworkPolicy(network, domain=domain), NetworkPolicy.load(path, graph=simulator.graph)
    for _ in range(20):
        choice = policy.decide(simulator)
        assert (loaded.decide(simulator) == choice).all()
        simulator.step(choice)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            {"slots": {"plane": 9}},
            r"sizes: .*slots: expected a number for each of \['crew', 'plane'\], got \['plane'\]",
        ),
        ({"slots": {"plane": 9, "crew": 0}}, r"sizes\.slots.*`int` >= 1"),
        ({"slots": {"plane": 8, "crew": 4}}, r"stack\.0\.weight: expected torch.float32 of shape"),
        ({"architecture": "alexnet"}, r"sizes: .*unknown network 'alexnet'. Known: decima, deeprm, hetgat"),
        ({"architecture": "decima"}, r"sizes: .*unknown field `slots`"),
    ],
)
def test_a_card_that_does_not_fit_its_weights_is_refused(damage, message: str, fleet, tmp_path):
    network = DeepRMNetwork(fleet, slots={"plane": 9, "crew": 4}, hidden=6)
    card = PolicyCard(
        domain="airme", objective="profit", view={"kind": "full"}, graph=fleet, sizes=network.sizes, command="none",
        git_hash="", seed=0, scores={},
    )  # fmt: skip
    save_network(tmp_path / "mine.safetensors", network, card)
    content = read_json(tmp_path / "mine.json")
    content["sizes"] |= damage
    write_json(tmp_path / "mine.json", content)
    with pytest.raises(InvalidFileError, match=message):
        load_network(tmp_path / "mine.json")


def test_every_architecture_is_made_from_its_sizes(fleet):
    slots = {"plane": 9, "crew": 4}
    for sizes, kind in (
        (HetGATConfig(width=4, heads=2, layers=1), HetGATNetwork),
        (DecimaConfig(hidden=4, layers=2), DecimaNetwork),
        (DeepRMConfig(hidden=4, layers=2, slots=slots), DeepRMNetwork),
    ):
        network = sizes.build(fleet)
        assert type(network) is kind
        assert config_of_card(network.sizes) == sizes
        assert network.permutation_equivariant == (kind is not DeepRMNetwork)

"""What the networks promise beyond their formula: nothing hidden leaks, size and order of nodes do not matter."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call

from marl_sched.agents.networks.hetgat.inputs import read_graph
from marl_sched.agents.networks.hetgat.network import HetGATCritic, HetGATEncoder, HetGATNetwork
from marl_sched.graph import ACTION_MASK, DECISION, STATE, GraphSpec

Observation = Mapping[str, Tensor]


def network_for(graph: GraphSpec, seed: int = 0, **sizes: int) -> HetGATNetwork:
    """A network whose logits differ by much more than rounding."""
    torch.manual_seed(seed)
    network = HetGATNetwork(graph, **sizes)
    nn.init.normal_(network.readout.weight)
    return network


def doubles(observation: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The observation in float64, in which sums of some thousand terms agree to 1e-12 in whatever order they are taken.

    Exact claims are held in float64: the order of a float32 sum, and so its last digits, differ between processors.
    """
    return {name: values.double() if values.is_floating_point() else values for name, values in observation.items()}


def critic_for(graph: GraphSpec, **options: int) -> HetGATCritic:
    """A critic whose last layers are not zero, as they are before training."""
    torch.manual_seed(1)
    critic = HetGATCritic(graph, **options)
    for parameter in [*critic.node_terms.parameters(), *critic.state_term.parameters()]:
        nn.init.normal_(parameter)
    return critic


def with_nan_where_hidden(graph: GraphSpec, observation: Observation) -> dict[str, Tensor]:
    """The observation with NaN features in hidden nodes and off the edges, and wild indices in hidden slots."""
    out = dict(observation)
    hidden = {node.name: observation[f"{node.name}_mask"] == 0 for node in graph.nodes}
    for name, mask in hidden.items():
        out[name] = observation[name].masked_fill(mask[..., None], float("nan"))
    for relation in graph.relations:
        if relation.attributes:
            off = (observation[relation.name] == 0) | hidden[relation.source][:, None]
            name = f"{relation.name}_attributes"
            out[name] = observation[name].masked_fill(off[..., None], float("nan"))
        if relation.index:
            owner = relation.source if relation.pattern == "scatter" else relation.target
            out[relation.index] = out[relation.index].masked_fill(hidden[owner], 10**9)
    return out


def padded(graph: GraphSpec, observation: Observation, extra: int) -> dict[str, Tensor]:
    """The observation with `extra` empty slots of every node type."""
    out = dict(observation)

    def grow(name: str, axes: int, value: int = 0) -> None:
        last = [0, 0] * (out[name].dim() - 1 - axes)
        out[name] = nn.functional.pad(out[name], [*last, *([0, extra] * axes)], value=value)

    for node in graph.nodes:
        grow(node.name, 1)
        grow(f"{node.name}_mask", 1)
    for relation in graph.relations:
        if relation.pattern == "dense":
            grow(relation.name, 2)
            if relation.attributes:
                grow(f"{relation.name}_attributes", 2)
    for index in {relation.index for relation in graph.relations if relation.index}:
        grow(index, 1, value=-1)
    grow(ACTION_MASK, 1)
    return out


def test_nan_in_hidden_slots_changes_no_bit_of_logits_and_values(graph, sizes, observe):
    observation = observe(graph, sizes, batch=6)
    poisoned = with_nan_where_hidden(graph, observation)
    assert any(values.isnan().any() for values in poisoned.values() if values.is_floating_point())
    network, critic = network_for(graph), critic_for(graph)
    assert torch.equal(network(poisoned), network(observation))
    assert torch.equal(critic(poisoned), critic(observation))


def test_nan_in_hidden_slots_reaches_no_gradient(graph, sizes, observe):
    network, critic = network_for(graph), critic_for(graph)
    poisoned = with_nan_where_hidden(graph, observe(graph, sizes))
    legal = poisoned[ACTION_MASK] != 0
    (network(poisoned)[legal].sum() + critic(poisoned).sum()).backward()
    for name, parameter in [*network.named_parameters(), *critic.named_parameters()]:
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_a_visible_node_does_change_the_logits_of_others(graph, sizes, observe):
    observation = observe(graph, sizes)
    changed = dict(observation)
    changed[graph.decision_of] = observation[graph.decision_of].clone()
    changed[graph.decision_of][:, 0] += 1.0
    network = network_for(graph)
    assert not torch.allclose(network(changed)[:, 1:], network(observation)[:, 1:])


@pytest.mark.parametrize("extra", [1, 13])
def test_padding_changes_nothing(graph, sizes, observe, extra: int):
    observation = doubles(observe(graph, sizes, batch=5))
    larger = padded(graph, observation, extra)
    network, critic = network_for(graph).double(), critic_for(graph).double()
    n_actions = sizes[graph.decision_of]
    logits = network(larger)
    torch.testing.assert_close(logits[:, :n_actions], network(observation), rtol=1e-12, atol=1e-12)
    assert (logits[:, n_actions:] == torch.finfo(torch.float64).min).all()
    torch.testing.assert_close(critic(larger), critic(observation), rtol=1e-12, atol=1e-12)


def test_permuting_planes_permutes_decisions_and_nothing_else(fleet, observe):
    observation = doubles(observe(fleet, {"plane": 9, "crew": 4}, batch=5))
    order = torch.tensor([0, 4, 2, 8, 1, 3, 7, 5, 6])
    moved = dict(observation)
    for name in ("plane", "plane_mask", ACTION_MASK):
        moved[name] = observation[name][:, order]
    place = torch.argsort(order)
    repairing = observation["repairing"]
    moved["repairing"] = torch.where(repairing >= 0, place[repairing.clamp(min=0)], -1)
    network, critic = network_for(fleet).double(), critic_for(fleet).double()
    torch.testing.assert_close(network(moved), network(observation)[:, order], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(critic(moved), critic(observation), rtol=1e-12, atol=1e-12)


def test_a_row_does_not_depend_on_the_rest_of_its_batch(graph, sizes, observe):
    observation = doubles(observe(graph, sizes, batch=6))
    network = network_for(graph).double()
    together = network(observation)
    for b in range(6):
        alone = network({name: values[b : b + 1] for name, values in observation.items()})
        torch.testing.assert_close(alone[0], together[b], rtol=1e-12, atol=1e-12)


def test_the_same_weights_run_on_small_and_large(graph, sizes, observe):
    network, critic = network_for(graph), critic_for(graph)
    for factor in (1, 10):
        larger = {name: n * factor for name, n in sizes.items()}
        observation = observe(graph, larger)
        assert network(observation).shape == (3, larger[graph.decision_of])
        assert critic(observation).shape == (3,)


def test_weights_computed_beforehand_give_the_same_logits(graph, sizes, observe):
    network, observation = network_for(graph), observe(graph, sizes)
    assert torch.equal(network(observation, network.weights()), network(observation))


def test_an_empty_graph_gives_finite_logits_and_action_zero_alone(graph, sizes, observe):
    observation = {name: torch.zeros_like(values) for name, values in observe(graph, sizes).items()}
    for index in {relation.index for relation in graph.relations if relation.index}:
        observation[index] -= 1
    observation[ACTION_MASK][:, 0] = 1
    logits = network_for(graph)(observation)
    assert logits.isfinite().all()
    probabilities = logits.softmax(-1)
    assert (probabilities[:, 0] == 1).all()
    assert (-(probabilities * logits.log_softmax(-1)).sum(-1)).isfinite().all()


def test_gradients_are_those_of_the_formula(graph, sizes, observe):
    """Sums are updated in place in the forward pass; finite differences know nothing of that."""
    torch.manual_seed(0)
    encoder = HetGATEncoder(graph, width=2, heads=2, layers=2, outputs=[DECISION, STATE]).double()
    names, values = zip(*encoder.named_parameters(), strict=True)
    observation = observe(graph, sizes, batch=2)
    visible = read_graph(graph, observation, []).masks[DECISION]

    def outputs(*parameters: Tensor) -> tuple[Tensor, Tensor]:
        nodes, _ = functional_call(encoder, dict(zip(names, parameters, strict=True)), (observation,))
        return nodes[DECISION][visible], nodes[STATE]

    assert torch.autograd.gradcheck(outputs, values, fast_mode=True)


def test_the_last_layer_has_no_weights_for_nodes_that_no_decision_reads(fleet):
    layers = HetGATNetwork(fleet, layers=3).encoder.layers
    assert set(layers[0].outputs) == {"plane", "crew", STATE, DECISION}
    assert set(layers[1].outputs) == {"plane", STATE, DECISION}
    assert set(layers[2].outputs) == {DECISION}


def test_a_critic_is_a_sum_over_visible_nodes_and_the_state(graph, sizes, observe):
    observation = observe(graph, sizes)
    critic = critic_for(graph)
    nodes, read = critic.encoder(observation)
    expected = critic.state_term(nodes[STATE][:, 0]).squeeze(-1)
    for name, term in critic.node_terms.items():
        for b, i in read.masks[name].nonzero().tolist():
            expected[b] += term(nodes[name][b, i]).squeeze()
    torch.testing.assert_close(critic(observation), expected)


def test_a_critic_reads_its_extra_inputs(graph, sizes, observe):
    critic, observation = critic_for(graph, extra=1), observe(graph, sizes)
    early, late = critic(observation, torch.zeros(3, 1)), critic(observation, torch.ones(3, 1))
    assert not torch.allclose(early, late)


def test_untrained_networks_explore_all_legal_targets_alike_and_value_everything_at_zero(graph, sizes, observe):
    observation = observe(graph, sizes)
    probabilities = HetGATNetwork(graph)(observation).softmax(-1)
    legal = observation[ACTION_MASK] != 0
    uniform = 1 / legal.sum(-1, keepdim=True)
    assert torch.where(legal, (probabilities - uniform).abs(), 0.0).max() < 0.1 * uniform.min()
    assert (HetGATCritic(graph)(observation) == 0).all()


def test_a_forward_pass_on_a_single_node_leaves_the_weights_as_they_are(fleet, observe):
    network = network_for(fleet)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    with torch.inference_mode():
        network(observe(fleet, {"plane": 1, "crew": 1}, batch=1))
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, before[name]), name

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_sched.agents.networks import batches
from marl_sched.agents.networks.batches import logits_in_blocks
from marl_sched.agents.networks.compaction import compacted
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.domain import get_domain

VIEWS = {
    "airme": {"kind": "local", "reach": 1, "comm": 1, "staleness": 0},
    "murse": {"kind": "local", "sensing": 3.0, "comm": 3.0},
}


def played(domain_name: str, turns: int, rows: int = 6) -> tuple[object, dict[str, torch.Tensor]]:
    domain = get_domain(domain_name)
    view = domain.make_view(VIEWS[domain_name])
    simulator = domain.simulator(domain.instances("small", rows, 0), view=view, pad="small")
    rng = np.random.default_rng(0)
    for _ in range(turns):
        legal = simulator.legal()
        simulator.step(np.array([rng.choice(np.flatnonzero(row)) for row in legal]))
    observation = simulator.observe(simulator.acting)
    return simulator.graph, {name: torch.from_numpy(array) for name, array in observation.items()}


def network_for(graph, dtype=torch.float64) -> HetGATNetwork:
    torch.manual_seed(0)
    network = HetGATNetwork(graph, width=4, heads=2, layers=3).to(dtype)
    torch.nn.init.normal_(network.readout.weight)
    return network


@pytest.mark.parametrize(("domain", "turns"), [("airme", 40), ("murse", 7)])
def test_hidden_nodes_are_cut_off_and_logits_stay(domain: str, turns: int):
    graph, observation = played(domain, turns)
    small, names = compacted(graph, observation)
    decided = graph.decision_of
    assert small[decided].shape[1] < observation[decided].shape[1]
    network = network_for(graph)
    ours, full = network(small), network(observation)
    visible = small[f"{decided}_mask"] != 0
    assert torch.allclose(ours[visible], full.gather(1, names)[visible], atol=1e-12)


def test_logits_stay_where_anything_may_be_hidden_and_types_share_slots(graph, sizes, observe):
    observation = observe(graph, {name: 3 * size for name, size in sizes.items()}, batch=5)
    small, names = compacted(graph, observation)
    assert small[graph.decision_of].shape[1] < observation[graph.decision_of].shape[1]
    network = network_for(graph)
    visible = small[f"{graph.decision_of}_mask"] != 0
    assert torch.allclose(network(small)[visible], network(observation).gather(1, names)[visible], atol=1e-12)


def test_links_survive_the_move():
    graph, observation = played("airme", 40)
    small, names = compacted(graph, observation)
    linked = 0
    for row, crews in enumerate(observation["repairing"]):
        seen = {int(p) for p, crew in zip(crews, observation["crew_mask"][row], strict=True) if crew and p >= 0}
        kept = {int(names[row, p]) for p in small["repairing"][row] if p >= 0}
        assert kept == {p for p in seen if observation["plane_mask"][row, p]}
        linked += len(kept)
    assert linked > 0


def test_actions_keep_their_names_and_action_0_stays_first():
    graph, observation = played("airme", 3)
    small, names = compacted(graph, observation)
    assert (names[:, 0] == 0).all()
    for row in range(len(names)):
        kept = names[row][small["plane_mask"][row] != 0]
        assert kept.tolist() == observation["plane_mask"][row].nonzero().squeeze(1).tolist()
        assert torch.equal(small["action_mask"][row], observation["action_mask"][row][names[row]])


@pytest.mark.parametrize("block_nodes", [1, 40, 10_000])
@pytest.mark.parametrize(("domain", "turns"), [("airme", 40), ("murse", 7)])
def test_blocks_of_any_size_give_the_logits_of_the_whole(domain: str, turns: int, block_nodes: int, monkeypatch):
    graph, observation = played(domain, turns)
    network = network_for(graph, torch.float64)
    monkeypatch.setattr(batches, "BLOCK_NODES", block_nodes)
    whole, ours = network(observation), logits_in_blocks(network, observation, network.weights())
    assert ours.shape == whole.shape
    torch.testing.assert_close(ours, whole, rtol=1e-12, atol=1e-12)
    assert torch.equal(ours.argmax(1), whole.argmax(1))


def test_nodes_of_a_network_that_tells_slots_apart_stay_in_theirs():
    graph, observation = played("airme", 3)

    class BySlot(HetGATNetwork):
        permutation_equivariant = False

        def forward(self, observation, weights=None):
            return observation["plane"].sum(2) * torch.arange(observation["plane"].shape[1])

    network = BySlot(graph)
    assert torch.equal(logits_in_blocks(network, observation, None), network(observation))

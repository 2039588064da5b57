from __future__ import annotations

import numpy as np
import torch

from marl_sched.agents.hetgat.network import HetGATNetwork
from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import LocalView
from marl_sched.train.compaction import compacted


def played(turns: int) -> tuple[object, dict[str, torch.Tensor]]:
    domain = get_domain("airme")
    simulator = domain.simulator(domain.instances("small", 6, 0), view=LocalView(reach=1, comm=1), pad="small")
    rng = np.random.default_rng(0)
    for _ in range(turns):
        legal = simulator.legal()
        simulator.step(np.array([rng.choice(np.flatnonzero(row)) for row in legal]))
    observation = simulator.observe(simulator.acting)
    return simulator.graph, {name: torch.from_numpy(array) for name, array in observation.items()}


def test_hidden_nodes_are_cut_off_and_logits_stay():
    graph, observation = played(40)
    small, names = compacted(graph, observation)
    assert small["plane"].shape[1] < observation["plane"].shape[1]
    assert (observation["repairing"] >= 0).any()
    torch.manual_seed(0)
    network = HetGATNetwork(graph, width=4, heads=2, layers=3).double()
    torch.nn.init.normal_(network.readout.weight)
    ours, full = network(small), network(observation)
    visible = small["plane_mask"] != 0
    assert torch.allclose(ours[visible], full.gather(1, names)[visible], atol=1e-12)


def test_targets_keep_their_names_and_target_0_stays_first():
    graph, observation = played(3)
    small, names = compacted(graph, observation)
    assert (names[:, 0] == 0).all()
    for row in range(len(names)):
        kept = names[row][small["plane_mask"][row] != 0]
        assert kept.tolist() == observation["plane_mask"][row].nonzero().squeeze(1).tolist()
        assert torch.equal(small["action_mask"][row], observation["action_mask"][row][names[row]])

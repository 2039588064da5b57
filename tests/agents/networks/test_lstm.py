"""The recurrent network against torch's own LSTM over whole sequences, and its gradient against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from marl_sched.agents.networks.lstm import LstmNetwork
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.networks.registry import config_of_card, network_config, networks
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.agents.policies.checkpoint import load_network, save_network
from marl_sched.agents.policies.network_policy import NetworkPolicy, RecurrentPolicy, policy_of
from marl_sched.agents.recurrent import LocalAgent
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.graph import GraphSpec, NodeType

SPEC = GraphSpec(
    nodes=(NodeType("task", ("a", "b")), NodeType("agent", ("acting",))), state_features=("s",), relations=(),
    decision_of="task",
)  # fmt: skip
N_TASKS, N_AGENTS = 4, 2


def network(seed: int = 0, spec: GraphSpec = SPEC) -> LstmNetwork:
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        made = LstmNetwork(spec, hidden=5, layers=2, units=3)
        for parameter in made.parameters():  # no layer so small that a wrong one would not be noticed
            nn.init.normal_(parameter, std=0.5)
        return made.double()


def observations(count: int, seed: int = 0) -> dict[str, Tensor]:
    """`count` observations, with a hidden task in each that holds NaN and an action that is not legal."""
    rng = np.random.default_rng(seed)
    task_mask, legal = np.ones((count, N_TASKS), np.int8), np.ones((count, N_TASKS), np.int8)
    task_mask[:, 3] = legal[:, 3] = legal[:, 2] = 0
    task = rng.normal(size=(count, N_TASKS, 2))
    task[:, 3] = np.nan
    arrays = {
        "task": task, "task_mask": task_mask, "agent": rng.normal(size=(count, N_AGENTS, 1)),
        "agent_mask": np.ones((count, N_AGENTS), np.int8), "state": rng.normal(size=(count, 1)), "action_mask": legal,
    }  # fmt: skip
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


# Two sequences, of 3 and of 2 decisions, in the order of a PackedSequence.
PLACE = torch.tensor([0, 0, 1, 1, 2])
FIRST, SECOND = [0, 2, 4], [1, 3]


def test_unrolled_sequences_are_those_of_torchs_lstm_over_the_whole_sequence():
    """torch.nn.LSTM with the cell's weights gives the outputs h from which the scores are made."""
    net, seen, memory = network(), observations(5), torch.randn(5, 6, dtype=torch.float64)
    lstm = nn.LSTM(net.cell.input_size, 3).double()
    lstm.load_state_dict({f"{name}_l0": value for name, value in net.cell.state_dict().items()})
    logits = net.unroll(seen, memory, PLACE)
    inputs, nodes = net.encode(seen)
    for sequence in (FIRST, SECOND):
        h, c = memory[sequence[0]].chunk(2)
        outputs, _ = lstm(inputs[sequence], (h[None], c[None]))
        for place, decision in enumerate(sequence):
            beside = torch.cat([nodes[decision], outputs[place].expand(N_TASKS, 3)], dim=1)
            wanted = net.q(beside).squeeze(-1)
            # sums of ten terms of order 1 in float64
            torch.testing.assert_close(logits[decision, :2], wanted[:2], rtol=1e-12, atol=1e-12)


def test_decisions_one_by_one_are_those_of_the_unrolled_sequence():
    net, seen, memory = network(), observations(5), torch.randn(5, 6, dtype=torch.float64)
    logits = net.unroll(seen, memory, PLACE)
    for sequence in (FIRST, SECOND):
        carried = memory[sequence[:1]]
        for decision in sequence:
            one = {name: values[decision : decision + 1] for name, values in seen.items()}
            found, carried = net.recur(one, carried)
            torch.testing.assert_close(found[0], logits[decision], rtol=1e-12, atol=1e-12)


def test_gradients_flow_back_to_the_beginning_of_a_sequence_as_in_one_unrolled_by_hand():
    """Of the last decision alone: by hand, two steps of the cell whose gates are written out."""
    net, seen = network(), observations(2)
    memory = torch.randn(2, 6, dtype=torch.float64, requires_grad=True)
    loss = net.unroll(seen, memory, torch.tensor([0, 1]))[1].log_softmax(0)[0]
    got = torch.autograd.grad(loss, [memory, *net.cell.parameters()])

    by_hand = memory[:1]
    inputs, nodes = net.encode(seen)
    for step in range(2):
        h, c = by_hand.chunk(2, dim=1)
        gates = inputs[step] @ net.cell.weight_ih.T + net.cell.bias_ih + h @ net.cell.weight_hh.T + net.cell.bias_hh
        i, f, g, o = gates.chunk(4, dim=1)
        c = f.sigmoid() * c + i.sigmoid() * g.tanh()
        by_hand = torch.cat([o.sigmoid() * c.tanh(), c], dim=1)
    scores = net.q(torch.cat([nodes[1], by_hand[:, :3].expand(N_TASKS, 3)], dim=1)).squeeze(-1)
    wanted = torch.autograd.grad(scores[:2].log_softmax(0)[0], [memory, *net.cell.parameters()])
    for ours, theirs in zip(got, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)
    assert got[0][0].abs().min() > 0  # the first memory has a part in the second decision
    assert not got[0][1].any()  # what was stored for the second is not read


def test_the_memory_changes_decisions_and_masked_actions_are_never_taken():
    net, seen = network(), observations(1)
    logits, after = net.recur(seen, torch.zeros(1, 6, dtype=torch.float64))
    again, _ = net.recur(seen, after)
    assert not torch.equal(logits, again)
    assert (logits[:, 2:] == torch.finfo(torch.float64).min).all()
    assert torch.isfinite(after).all()


def test_it_is_registered_by_its_struct_and_comes_back_from_its_card(tmp_path):
    config = network_config({"name": "lstm", "hidden": 5, "layers": 2, "units": 3})
    assert type(config) is networks()["lstm"]
    assert (config.memory_size, config_of_card(config.as_card())) == (6, config)
    net = network().float()
    card = PolicyCard(
        domain="toy", objective="o", view={"kind": "full"}, graph=SPEC, sizes=net.sizes, command="", git_hash="",
        seed=0, scores={},
    )  # fmt: skip
    save_network(tmp_path / "p.safetensors", net, card)
    loaded, _ = load_network(tmp_path / "p.safetensors")
    assert isinstance(loaded, LstmNetwork)
    assert isinstance(RecurrentPolicy.load(tmp_path / "p.json"), RecurrentPolicy)


@pytest.mark.parametrize("mode", ["greedy", "sample"])
@pytest.mark.parametrize(
    ("name", "scale", "view", "horizon"), [("airme", "small", "local", 20), ("murse", "small", "full", 1)]
)
def test_it_plays_every_domain_and_an_agent_by_itself_decides_as_in_the_batch(name, scale, view, horizon, mode):
    """Three envs at once, and every agent of each alone with its own memory: the same decisions.

    Logits agree within 1e-5 and memories with them; with these weights no decision is as close as that.
    """
    domain = get_domain(name)
    simulator = domain.simulator(domain.instances(scale, 3, 0), horizon=horizon, view=domain.make_view(view))
    net = network(1, simulator.graph).float()
    policy = policy_of(net, mode=mode, domain=name)
    agents = [[LocalAgent(policy_of(net, mode=mode, domain=name)) for _ in range(simulator.max_agents)] for _ in "abc"]
    policy.start(simulator, np.ones(3, bool))
    decisions = 0
    while not simulator.over.all() and decisions < 300:
        actions = policy.decide(simulator)
        seen, noise = simulator.observe(simulator.acting), simulator.policy_noise(simulator.acting)
        for row in np.flatnonzero(simulator.acting >= 0):
            own = {key: values[row] for key, values in seen.items()}
            assert agents[row][simulator.acting[row]].act(own, float(noise[row])) == actions[row]
            decisions += 1
        simulator.step(actions)
    assert decisions > 20


def test_a_policy_with_a_memory_is_not_taken_for_one_without():
    net = network()
    with pytest.raises(InvalidOptionError, match="expected RecurrentPolicy"):
        NetworkPolicy(net)
    with pytest.raises(InvalidOptionError, match="expected greedy or sample"):
        policy_of(net, mode="one_pass")
    other: PolicyNetwork = networks()["decima"](hidden=4, layers=2).build(SPEC)  # type: ignore[call-arg]
    with pytest.raises(InvalidOptionError, match="expected a recurrent network, got DecimaNetwork"):
        RecurrentPolicy(other)

"""The turns of an update as sequences of each agent's own, and a recurrent policy that learns from them."""

from __future__ import annotations

import numpy as np
import torch

from marl_sched.agents.networks.hetgat.network import HetGATCritic
from marl_sched.agents.networks.lstm import LstmNetwork
from marl_sched.agents.networks.network import MEMORY
from marl_sched.graph import ACTION_MASK
from marl_sched.train.actor import LOG_PROB
from marl_sched.train.algorithms.critic import CriticEstimator, OwnTurns
from marl_sched.train.collect import EpisodeCollector, SegmentCollector
from marl_sched.train.environment import REMEMBERED
from marl_sched.train.ppo import Ppo, samples_of
from marl_sched.train.sequences import PLACE, SEQUENCE, logits_of, minibatches, own_sequences, packed
from tests.train.playing import task
from tests.train.test_ppo import CONFIG


def test_sequences_are_an_agents_own_turns_of_one_episode():
    """Row 0: agents 0 1 0 | 0 1, an episode ends after the third turn. Row 1: agents 1 1 0 0 and one turn too many."""
    agents = torch.tensor([[0, 1], [1, 1], [0, 0], [0, 0], [1, -1]])
    boundary = torch.zeros(5, 2, dtype=torch.bool)
    boundary[2, 0] = boundary[4, 0] = boundary[3, 1] = boundary[4, 1] = True
    valid = torch.ones(5, 2, dtype=torch.bool)
    valid[4, 1] = False
    turn, row, sequence, place = own_sequences(agents, valid, boundary, valid, None)
    found = [[] for _ in range(int(sequence.max()) + 1)]
    for t, b, s, p in zip(*(values.tolist() for values in (turn, row, sequence, place)), strict=True):
        assert p == len(found[s])
        found[s].append((t, b))
    assert found == [[(0, 0), (2, 0)], [(1, 0)], [(3, 0)], [(4, 0)], [(2, 1), (3, 1)], [(0, 1), (1, 1)]]


def test_long_sequences_are_cut_and_those_without_a_turn_to_learn_from_are_left_out():
    """Five turns of one agent in pieces of two; nothing is to be learned from the third and the fourth."""
    ones = torch.ones(5, 1, dtype=torch.bool)
    learned = torch.tensor([[True], [False], [False], [False], [True]])
    ends = torch.tensor([[False]] * 4 + [[True]])
    turn, _, sequence, place = own_sequences(torch.zeros(5, 1, dtype=torch.long), ones, ends, learned, 2)
    assert (turn.tolist(), sequence.tolist(), place.tolist()) == ([0, 1, 4], [0, 0, 1], [0, 1, 0])


def test_minibatches_hold_whole_sequences_as_torch_packs_them():
    lengths = np.array([2, 4, 1, 3])
    sequence = torch.from_numpy(np.repeat(np.arange(4), lengths))
    starts = lengths.cumsum() - lengths
    by_torch = torch.nn.utils.rnn.pack_sequence([torch.arange(10)[sequence == s] for s in (1, 3, 0, 2)])
    assert packed(starts, lengths).tolist() == by_torch.data.tolist()
    from tensordict import TensorDict

    samples = TensorDict({SEQUENCE: sequence}, batch_size=[10])
    batches = list(minibatches(samples, 5, 2, np.random.default_rng(0)))
    assert len(batches) == 4
    for epoch in (batches[:2], batches[2:]):
        assert sorted(torch.cat(epoch).tolist()) == list(range(10))
        assert not set(sequence[epoch[0]].tolist()) & set(sequence[epoch[1]].tolist())


def networks() -> tuple[LstmNetwork, HetGATCritic]:
    torch.manual_seed(0)
    graph = task().environment(0, 1).simulator.graph
    policy = LstmNetwork(graph, hidden=8, layers=2, units=8)
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return policy, HetGATCritic(graph, width=4, heads=2, layers=1)


def segments(policy: LstmNetwork):
    """Two updates of 120 turns of 4 rows, with episodes of 20 hours."""
    playing = task(central=True, turns=120, length=20, memory=policy.memory_size)
    collector = SegmentCollector(playing)
    return [collector.collect(policy, playing.length(0)) for _ in range(2)]


def test_an_agent_meets_what_it_remembered_at_its_last_turn_and_nothing_at_the_start_of_an_episode():
    policy, _ = networks()
    turns = torch.cat([rollout.data for rollout in segments(policy)], 1)
    carried, fresh = 0, 0
    for row in range(4):
        last: dict[int, torch.Tensor] = {}
        for t in range(turns.shape[1]):
            now = turns[row, t]
            agent = int(now["acting"])
            expected = last.get(agent, torch.zeros(policy.memory_size))
            assert torch.equal(now[MEMORY], expected)
            carried, fresh = carried + (agent in last), fresh + (agent not in last)
            last[agent] = now[REMEMBERED]
            if now["next", "done"]:
                last = {}
    assert carried > 50
    assert fresh > 20


def test_unrolled_log_probabilities_are_those_of_the_policy_that_acted():
    """With unchanged parameters every ratio of the surrogate is 1 up to rounding, in each of two updates.

    1e-4: some hundred float32 operations on numbers of order 1, unrolled over up to 30 decisions.
    """
    policy, critic = networks()
    for rollout in segments(policy):
        estimate = CriticEstimator(critic, discount=0.9, gae_lambda=0.9, reward_centering=True).estimate(rollout)
        samples = samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0))
        assert samples.shape[0] == rollout.decisions
        assert samples[PLACE].max() > 3
        (indices,) = minibatches(samples, 10**6, 1, np.random.default_rng(0))
        batch = samples[indices]
        log_probs = logits_of(policy, batch).log_softmax(-1).gather(1, batch["action"][:, None])[:, 0]
        torch.testing.assert_close(log_probs, batch[LOG_PROB], atol=1e-4, rtol=0)


def test_turns_that_are_not_learned_from_are_passed_through_without_weight():
    """Along own turns the last ones of an update are not learned from, but the sequence goes through them."""
    policy, critic = networks()
    rollout = segments(policy)[0]
    estimate = OwnTurns(critic, discount=0.9, gae_lambda=0.9, reward_centering=True).estimate(rollout)
    samples = samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0), bptt=3)
    assert samples[PLACE].max() == 2
    assert 0 < (samples["weight"] == 0).sum() < samples.shape[0]
    assert (samples["weight"] > 0).sum() == estimate.loss_mask.sum()
    report = Ppo(policy, critic, CONFIG).update(samples, 0.0, np.random.default_rng(1))
    assert all(np.isfinite(value) for value in vars(report).values())
    assert all(torch.isfinite(parameter).all() for parameter in policy.parameters())


def test_a_recurrent_policy_learns_from_whole_episodes_whose_rows_end_at_different_times():
    policy, _ = networks()
    rollout = EpisodeCollector(task(rows=4, episodes=2, turns=None, memory=policy.memory_size)).collect(policy, 10)
    assert (~rollout.valid).any()
    turn, row, _, place = own_sequences(rollout.agents, rollout.valid, rollout.boundary, rollout.valid, None)
    assert len(turn) == rollout.decisions
    assert not rollout.data[MEMORY][row, turn][place == 0].any()
    assert rollout.data[ACTION_MASK][row, turn][:, 0].all()

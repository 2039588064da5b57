from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from marl_sched.agents.networks.hetgat.network import HetGATCritic, HetGATNetwork
from marl_sched.agents.networks.network import PolicyNetwork, mask_logits
from marl_sched.errors import InvalidOptionError
from marl_sched.train.actor import ActingLogits, actor
from marl_sched.train.algorithms.critic import CriticEstimator, OwnTurns
from marl_sched.train.algorithms.step_baseline import StepBaseline
from marl_sched.train.collect import EpisodeCollector, Rollout
from marl_sched.train.estimators import Estimate
from marl_sched.train.learner import PolicyGradient
from marl_sched.train.ppo import Ppo, PpoConfig, importance_subsample, samples_of
from tests.train.playing import changed, segment, task

CONFIG = PpoConfig(
    clip=0.2, epochs=2, minibatch=64, learning_rate=1e-3, final_learning_rate=0.0, entropy=0.01, final_entropy=0.0,
    max_grad_norm=0.5, min_keep_prob=1.0,
    critic_warmup=0.0, policy_rate=1.0,
)  # fmt: skip


def networks() -> tuple[HetGATNetwork, HetGATCritic]:
    torch.manual_seed(0)
    graph = task().environment(0, 1).simulator.graph
    return HetGATNetwork(graph, width=4, heads=2, layers=2), HetGATCritic(graph, width=4, heads=2, layers=1)


def episodes(policy: HetGATNetwork, rows: int = 4) -> Rollout:
    return EpisodeCollector(task(rows=rows, episodes=2, turns=None)).collect(policy, 10)


def poisoned(rollout: Rollout) -> Rollout:
    """NaN wherever a turn is not valid."""
    names = [name for name in rollout.data.keys(True, True) if rollout.data[name].is_floating_point()]
    return changed(rollout, ~rollout.valid, torch.nan, *names)


def learn(
    rollout: Rollout, policy: HetGATNetwork, critic: HetGATCritic, min_keep_prob: float = 1.0
) -> list[torch.Tensor]:
    estimator = CriticEstimator(critic, discount=0.9, gae_lambda=0.9, reward_centering=True)
    samples = samples_of(policy, rollout, estimator.estimate(rollout), 1.0, np.random.default_rng(0))
    ppo = Ppo(policy, critic, CONFIG)
    for _ in range(2):
        ppo.update(samples, 0.0, np.random.default_rng(1))
    return [parameter.detach().clone() for module in (policy, critic) for parameter in module.parameters()]


def learn_from_episodes(rollout: Rollout, policy: HetGATNetwork) -> list[torch.Tensor]:
    estimate = StepBaseline(discount=0.99, episodes=2).estimate(rollout)
    samples = samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0))
    Ppo(policy, None, CONFIG).update(samples, 0.0, np.random.default_rng(1))
    return [parameter.detach().clone() for parameter in policy.parameters()]


def test_masked_turns_never_touch_a_loss_even_if_they_hold_nan():
    policy, _ = networks()
    rollout = episodes(policy)
    assert (~rollout.valid).any()
    clean = learn_from_episodes(rollout, networks()[0])
    dirty = learn_from_episodes(poisoned(rollout), networks()[0])
    assert all(torch.equal(a, b) for a, b in zip(clean, dirty, strict=True))
    assert all(torch.isfinite(parameter).all() for parameter in dirty)
    assert not all(torch.equal(a, b) for a, b in zip(clean, policy.parameters(), strict=True))


def test_valid_turns_do_touch_the_loss():
    policy, _ = networks()
    rollout = segment(policy)
    first = torch.zeros_like(rollout.valid)
    first[0, 0] = True
    rollout = changed(rollout, first, torch.nan, ("next", "reward"))
    assert not all(torch.isfinite(parameter).all() for parameter in learn(rollout, *networks()))


class Fixed(PolicyNetwork):
    """Gives the logits that it holds, whatever it sees."""

    permutation_equivariant = False

    def __init__(self, logits: torch.Tensor) -> None:
        super().__init__()
        self.spec = task().environment(0, 1).simulator.graph
        self.logits = torch.nn.Parameter(logits)

    def forward(self, observation: Mapping[str, torch.Tensor], weights: None = None) -> torch.Tensor:
        return mask_logits(self.logits, observation)


def batch(mask: list[list[int]], old: list[float], advantages: list[float]) -> TensorDict:
    count = len(old)
    return TensorDict(
        {
            "action_mask": torch.tensor(mask),
            "uniform": torch.zeros(count, dtype=torch.float64),
            "action": torch.zeros(count, dtype=torch.int64),
            "action_log_prob": torch.log(torch.tensor(old)),
            "advantage": torch.tensor(advantages)[:, None],
        },
        batch_size=[count],
    )


def test_clipped_surrogate_by_hand():
    # One sample each: ratio 1, above with gain (clipped), above with loss (not), below with loss (clipped).
    new = torch.tensor([0.5, 0.9, 0.9, 0.3])
    network = Fixed(torch.stack([torch.log(new), torch.log(1 - new)], 1))
    losses = Ppo(network, None, CONFIG).loss(batch([[1, 1]] * 4, [0.5, 0.6, 0.6, 0.6], [2.0, 1.0, -1.0, -1.0]))
    assert losses["loss_objective"].tolist() == pytest.approx([-2.0, -1.2, 1.5, 0.8])
    assert losses["loss_entropy"][0].item() == pytest.approx(-0.01 * math.log(2))
    assert losses["clip_fraction"].item() == 0.75


def test_illegal_targets_add_nothing_to_the_entropy_and_get_no_gradient():
    network = Fixed(torch.tensor([[0.0, 0.0, 7.0]]))
    losses = Ppo(network, None, CONFIG).loss(batch([[1, 1, 0]], [0.5], [1.0]))
    assert losses["loss_entropy"].item() == pytest.approx(-0.01 * math.log(2))
    (losses["loss_objective"] + losses["loss_entropy"]).sum().backward()
    assert network.logits.grad is not None
    assert torch.isfinite(network.logits.grad).all()
    assert network.logits.grad[0, 2] == 0


def test_the_actor_follows_the_policys_distribution():
    policy, _ = networks()
    torch.nn.init.normal_(policy.readout.weight, std=3.0)
    state = task(rows=1).environment().reset()
    states = state.expand(500).clone()
    states["uniform"] = (torch.arange(500, dtype=torch.float64) + 0.5) / 500
    with torch.no_grad():
        acted = actor(ActingLogits(policy))(states)
        expected = policy(state).softmax(-1)[0]
    counts = torch.bincount(acted["action"], minlength=len(expected)) / 500
    assert torch.allclose(counts, expected, atol=3e-3)
    assert torch.allclose(acted["action_log_prob"].exp(), expected[acted["action"]], atol=1e-5)


def test_kept_turns_weigh_as_much_as_all_turns_in_expectation():
    policy, _ = networks()
    torch.nn.init.normal_(policy.readout.weight, std=20.0)  # choices that are nearly certain
    rollout = segment(policy)
    everything = Estimate(torch.randn(rollout.rewards.shape, dtype=torch.float64), None, 0.0, rollout.valid)
    rng = np.random.default_rng(0)
    all_turns = samples_of(policy, rollout, everything, 1.0, rng)
    drawn = [samples_of(policy, rollout, everything, 0.2, rng) for _ in range(300)]
    assert np.mean([len(samples["weight"]) for samples in drawn]) < 0.8 * len(all_turns["weight"])
    sums = torch.stack([samples["weight"].double() @ samples["advantage"].double().square() for samples in drawn])
    truth = all_turns["advantage"].double().square().sum()
    assert sums.mean().item() == pytest.approx(truth.item(), rel=0.05)


def test_a_better_choice_becomes_more_probable():
    policy, _ = networks()
    rollout = episodes(policy)
    good = rollout.actions == 0
    estimate = Estimate(torch.where(good, 1.0, -1.0).double(), None, 0.0, rollout.valid)
    samples = samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0))
    idle = samples["action"] == 0
    assert idle.any()
    before = policy(samples).softmax(-1)[:, 0].mean()
    ppo = Ppo(policy, None, CONFIG)
    for _ in range(10):
        ppo.update(samples, 0.0, np.random.default_rng(0))
    assert policy(samples).softmax(-1)[:, 0].mean() > before


def test_the_step_baseline_needs_no_critic():
    policy, _ = networks()
    rollout = episodes(policy)
    estimate = StepBaseline(discount=0.99, episodes=2).estimate(rollout)
    assert estimate.value_targets is None
    assert (estimate.advantages[~rollout.valid] == 0).all()
    report = Ppo(policy, None, CONFIG).update(
        samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0)), 0.5, np.random.default_rng(0)
    )
    assert report.value_loss == 0.0
    assert report.entropy > 0


def test_a_policy_stays_as_it_is_while_the_critic_learns_alone_and_then_learns_at_its_own_rate() -> None:
    moved = {}
    for progress, rate in ((0.05, 1.0), (0.1, 1.0), (0.1, 0.1)):
        policy, critic = networks()
        rollout = segment(policy)
        estimate = CriticEstimator(critic, discount=0.9, gae_lambda=0.9, reward_centering=True).estimate(rollout)
        samples = samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0))
        before = [parameter.detach().clone() for module in (policy, critic) for parameter in module.parameters()]
        config = msgspec.structs.replace(CONFIG, critic_warmup=0.1, policy_rate=rate, epochs=1, minibatch=10**6)
        Ppo(policy, critic, config).update(samples, progress, np.random.default_rng(1))
        after = [parameter.detach() for module in (policy, critic) for parameter in module.parameters()]
        n = len(list(policy.parameters()))
        change = [float((b - a).abs().max()) for a, b in zip(before, after, strict=True)]
        moved[progress, rate] = max(change[:n]), max(change[n:])
    assert moved[0.05, 1.0][0] == 0.0
    assert moved[0.05, 1.0][1] > 0.0
    # Adam's first step has the length of the learning rate.
    assert moved[0.1, 0.1][0] == pytest.approx(0.1 * moved[0.1, 1.0][0], rel=1e-2)
    assert moved[0.1, 0.1][1] == moved[0.1, 1.0][1]


def test_a_critic_that_is_not_there_cannot_learn_alone() -> None:
    with pytest.raises(InvalidOptionError, match="critic_warmup"):
        Ppo(networks()[0], None, msgspec.structs.replace(CONFIG, critic_warmup=0.1))


def test_a_segment_in_which_no_agent_has_two_turns_is_refused() -> None:
    policy, critic = networks()
    rollout = segment(policy, turns=1)
    learner = PolicyGradient(
        Ppo(policy, critic, CONFIG), OwnTurns(critic, discount=0.9, gae_lambda=0.9, reward_centering=True)
    )
    with pytest.raises(InvalidOptionError, match=r"algorithm\.turns: .* 1 turns"):
        learner.learn(rollout, 0.0, np.random.default_rng(0))


def test_an_update_of_which_nothing_is_kept_is_refused() -> None:
    policy, _ = networks()
    rollout = segment(policy)
    certain = changed(rollout, rollout.valid, 0.0, "action_log_prob")
    with pytest.raises(InvalidOptionError, match=r"none of the .* turns of an update that count was kept"):
        importance_subsample(policy, certain, rollout.valid, 1e-12, np.random.default_rng(0))

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch

from marl_sched.agents.networks.hetgat.network import HetGATCritic, HetGATNetwork
from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import LocalView
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidOptionError
from marl_sched.train.algorithms.critic import CriticEstimator, OwnTurns
from marl_sched.train.algorithms.step_baseline import StepBaseline
from marl_sched.train.collect import EpisodeCollector, InstanceSource, Rollout, SegmentCollector
from marl_sched.train.estimators import Estimate
from marl_sched.train.learner import PolicyGradient
from marl_sched.train.ppo import Ppo, PpoConfig, Sampler, importance_subsample, policy_loss, samples_of

CONFIG = PpoConfig(
    clip=0.2, epochs=2, minibatch=64, learning_rate=1e-3, final_learning_rate=0.0, entropy=0.01, final_entropy=0.0,
    max_grad_norm=0.5, min_keep_prob=1.0,
)  # fmt: skip


def environment(rows: int = 4, episodes: int = 1) -> SchedulingTorchRL:
    source = InstanceSource(get_domain("airme"), ["small"], seed=3, rows=rows, episodes=episodes)
    return SchedulingTorchRL("airme", batch_size=rows, source=source, view=LocalView(), horizon=100, seed=3)


def networks() -> tuple[HetGATNetwork, HetGATCritic]:
    torch.manual_seed(0)
    graph = environment().simulator.graph
    return HetGATNetwork(graph, width=4, heads=2, layers=2), HetGATCritic(graph, width=4, heads=2, layers=1)


def segment(policy: HetGATNetwork) -> Rollout:
    return SegmentCollector(environment(), turns=30, length=8, central=True).collect(Sampler(policy), 8)


def poisoned(rollout: Rollout) -> Rollout:
    """NaN wherever a turn is not valid; what is alive there keeps its central graph, whose value counts."""
    gone = ~rollout.valid
    observation = {
        name: torch.where(gone.view(*gone.shape, *[1] * (array.dim() - 2)), torch.nan, array)
        if array.is_floating_point()
        else array
        for name, array in rollout.observation.items()
    }
    columns = {name: torch.where(gone[:-1], torch.nan, getattr(rollout, name)) for name in ("rewards", "log_probs")}
    return replace(rollout, observation=observation, **columns)


def learn(
    rollout: Rollout, policy: HetGATNetwork, critic: HetGATCritic, min_keep_prob: float = 1.0
) -> list[torch.Tensor]:
    estimator = CriticEstimator(critic, discount=0.9, gae_lambda=0.9, reward_centering=True)
    samples = samples_of(policy, rollout, estimator.estimate(rollout), min_keep_prob, np.random.default_rng(0))
    ppo = Ppo(policy, critic, CONFIG)
    for _ in range(2):
        ppo.update(samples, 0.0, np.random.default_rng(1))
    return [parameter.detach().clone() for module in (policy, critic) for parameter in module.parameters()]


def test_masked_turns_never_touch_a_loss_even_if_they_hold_nan():
    policy, critic = networks()
    rollout = segment(policy)
    assert (~rollout.valid[:-1]).any()
    clean = learn(rollout, *networks())
    dirty = learn(poisoned(rollout), *networks())
    assert all(torch.equal(a, b) for a, b in zip(clean, dirty, strict=True))
    assert all(torch.isfinite(parameter).all() for parameter in dirty)
    assert not all(torch.equal(a, b) for a, b in zip(clean, [*policy.parameters(), *critic.parameters()], strict=True))


def test_valid_turns_do_touch_the_loss():
    policy, _ = networks()
    rollout = segment(policy)
    rollout.rewards[0, 0] = torch.nan
    assert not all(torch.isfinite(parameter).all() for parameter in learn(rollout, *networks()))


def test_clipped_surrogate_by_hand():
    # One sample each: ratio 1, above with gain (clipped), above with loss (not), below with loss (clipped).
    new = torch.tensor([0.5, 0.9, 0.9, 0.3])
    logits = torch.stack([torch.log(new), torch.log(1 - new)], 1)
    old = torch.log(torch.tensor([0.5, 0.6, 0.6, 0.6]))
    losses, ratio, entropy = policy_loss(
        logits, torch.zeros(4, dtype=torch.int64), old, torch.tensor([2.0, 1.0, -1.0, -1.0]), 0.2
    )
    assert ratio.tolist() == pytest.approx([1.0, 1.5, 1.5, 0.5])
    assert losses.tolist() == pytest.approx([-2.0, -1.2, 1.5, 0.8])
    assert entropy[0].item() == pytest.approx(math.log(2))


def test_illegal_targets_add_nothing_to_the_entropy_and_get_no_gradient():
    logits = torch.tensor([[0.0, 0.0, torch.finfo(torch.float32).min]], requires_grad=True)
    losses, _, entropy = policy_loss(
        logits, torch.tensor([0]), torch.log(torch.tensor([0.5])), torch.tensor([1.0]), 0.2
    )
    assert entropy.item() == pytest.approx(math.log(2))
    (losses.sum() - entropy.sum()).backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    assert logits.grad[0, 2] == 0


def test_the_sampler_follows_the_policys_distribution():
    policy, _ = networks()
    torch.nn.init.normal_(policy.readout.weight, std=3.0)
    env = environment(rows=1)
    state = env.reset()
    observation = {name: state[name].expand(500, *state[name].shape[1:]) for name in env.simulator.arrays}
    uniform = (np.arange(500) + 0.5) / 500
    actions, log_probs = Sampler(policy)(observation, uniform)
    with torch.no_grad():
        expected = policy({name: array[:1] for name, array in observation.items()}).softmax(-1)[0]
        counts = torch.bincount(actions, minlength=len(expected)) / 500
        assert torch.allclose(counts, expected, atol=3e-3)
        assert torch.allclose(log_probs.exp(), expected[actions], atol=1e-5)


def test_kept_turns_weigh_as_much_as_all_turns_in_expectation():
    policy, _ = networks()
    torch.nn.init.normal_(policy.readout.weight, std=20.0)  # choices that are nearly certain
    rollout = segment(policy)
    everything = Estimate(torch.randn(rollout.rewards.shape, dtype=torch.float64), None, 0.0, rollout.valid[:-1])
    rng = np.random.default_rng(0)
    all_turns = samples_of(policy, rollout, everything, 1.0, rng)
    drawn = [samples_of(policy, rollout, everything, 0.2, rng) for _ in range(300)]
    assert np.mean([len(samples["weight"]) for samples in drawn]) < 0.8 * len(all_turns["weight"])
    sums = torch.stack([samples["weight"].double() @ samples["advantage"].double().square() for samples in drawn])
    truth = all_turns["advantage"].double().square().sum()
    assert sums.mean().item() == pytest.approx(truth.item(), rel=0.05)


def test_a_better_choice_becomes_more_probable():
    policy, _ = networks()
    rollout = EpisodeCollector(environment(rows=4, episodes=2), central=False).collect(Sampler(policy), 10)
    good = rollout.actions == 0
    estimate = Estimate(torch.where(good, 1.0, -1.0).double(), None, 0.0, rollout.valid[:-1])
    samples = samples_of(policy, rollout, estimate, 1.0, np.random.default_rng(0))
    idle = samples["target"] == 0
    assert idle.any()
    before = policy(samples["observation"]).softmax(-1)[:, 0].mean()
    ppo = Ppo(policy, None, CONFIG)
    for _ in range(10):
        ppo.update(samples, 0.0, np.random.default_rng(0))
    assert policy(samples["observation"]).softmax(-1)[:, 0].mean() > before


def test_the_step_baseline_needs_no_critic():
    policy, _ = networks()
    rollout = EpisodeCollector(environment(rows=4, episodes=2), central=False).collect(Sampler(policy), 10)
    estimate = StepBaseline(discount=0.99, episodes=2).estimate(rollout)
    assert estimate.value_targets is None
    assert (estimate.advantages[~rollout.valid[:-1]] == 0).all()
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
    rollout = SegmentCollector(environment(), turns=1, length=8, central=False).collect(Sampler(policy), 8)
    learner = PolicyGradient(
        Ppo(policy, critic, CONFIG), OwnTurns(critic, discount=0.9, gae_lambda=0.9, reward_centering=True)
    )
    with pytest.raises(InvalidOptionError, match=r"algorithm\.turns: .* 1 turns"):
        learner.learn(rollout, 0.0, np.random.default_rng(0))


def test_an_update_of_which_nothing_is_kept_is_refused() -> None:
    policy, _ = networks()
    rollout = segment(policy)
    certain = replace(rollout, log_probs=torch.zeros_like(rollout.log_probs))
    with pytest.raises(InvalidOptionError, match=r"none of the .* turns of an update that count was kept"):
        importance_subsample(policy, certain, rollout.valid[:-1], 1e-12, np.random.default_rng(0))

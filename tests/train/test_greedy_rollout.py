"""PPO on whole sequences with a greedy rollout baseline (algorithm 4): advantages, the surrogate, the baseline."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from marl_sched.errors import InvalidOptionError
from marl_sched.train.algorithms.greedy_rollout import (
    MOST,
    GreedyRollout,
    GreedyRolloutConfig,
    PlayedRound,
    SequenceCollector,
    clipped_surrogate,
    sequence_advantages,
    step_advantages,
)
from marl_sched.train.config import RunRecord, load_config
from marl_sched.train.parts import Parts, build

TINY = [
    "env=murse", "policy=hybridnet", "algorithm=greedy_rollout", "curriculum=rounds", "env.scales=[small]",
    "policy.width=2", "policy.heads=2", "policy.hidden=4", "policy.edge_width=2", "algorithm.instances=2",
    "algorithm.samples=2", "device=cpu", "+env.options.durations=deterministic", "validation.length=1",
    "validation.instances=1",
]  # fmt: skip


def config(*overrides: str) -> GreedyRolloutConfig:
    found = load_config([*TINY, *overrides]).algorithm
    assert isinstance(found, GreedyRolloutConfig)
    return found


def parts(*overrides: str) -> Parts:
    return build(RunRecord(config=load_config([*TINY, *overrides]), overrides=[], revision=""))


def played(costs: list[list[float]], baseline: list[float], samples: int) -> PlayedRound:
    """A round whose sequences have two choices."""
    p = np.size(costs) // samples
    return PlayedRound(
        situations=None,
        orders=np.zeros((p, samples, 2, 2), np.int64),
        log_probs=torch.zeros(p, samples, 2),
        seen=None,
        lengths=np.full(p, 2),
        costs=np.array(costs),
        baseline=np.array(baseline),
        appraisals=None,
        expected=None,
    )


def test_advantages_are_discounted_costs_to_go_against_the_baselines_as_shares_of_them():
    """Two rounds at discount 0.5; samples cost 10 + 4 / 2 and 6 + 8 / 2, its baseline 8 + 8 / 2."""
    rounds = [played([[10.0, 6.0]], [8.0], 2), played([[4.0, 8.0]], [8.0], 1)]
    first, second = sequence_advantages(rounds, msgspec.structs.replace(config(), discount=0.5))
    raw = np.array([[0.0, 2.0 / 12.0], [0.5, 0.0]])
    np.testing.assert_allclose(first.numpy()[0, :, 0], raw[0] / raw.std(), rtol=1e-6)
    np.testing.assert_allclose(second.numpy()[:, 0, 0], raw[1] / raw.std(), rtol=1e-6)
    mean, _ = sequence_advantages(rounds[:1], msgspec.structs.replace(config(), baseline="mean"))[0].numpy()[0, :, 0]
    assert mean == pytest.approx(-1.0)


def test_a_choices_advantage_sums_what_later_choices_save_and_the_last_one_what_the_round_brought():
    """Appraised at 100, 90, 95; executed for 97 where the baseline's 80 were executed for 81, so 1 of the 2 is noise.

    Rewards are 10 and -5 + 95 - 96 = -6; at lambda 0.5 the first has 10 - 3, of 100.
    """
    one = replace(played([[97.0]], [81.0], 1), appraisals=np.array([[[100.0, 90.0, 95.0]]]), expected=np.array([80.0]))
    found = step_advantages([one], msgspec.structs.replace(config(), gae_lambda=0.5))[0].numpy()[0, 0]
    size = math.sqrt((0.07**2 + 0.06**2) / 2)
    np.testing.assert_allclose(found, [0.07 / size, -0.06 / size], rtol=1e-5)
    assert np.abs(found).max() <= MOST


def test_the_surrogate_is_clipped_on_the_side_that_would_gain():
    """Equation 5.7 with ratios 2 and 0.5 at clip 0.2."""
    ratio = torch.tensor([2.0, 2.0, 0.5, 0.5]).log()
    gained = [float(clipped_surrogate(ratio[k : k + 1], torch.tensor([a]), 0.2)) for k, a in enumerate((1.0, -1.0) * 2)]
    assert gained == pytest.approx([1.2, -2.0, 0.5, -0.8])


def test_the_baseline_follows_the_policy_every_so_many_updates():
    made = parts("algorithm.renew=2", "algorithm.learning_rate=0.01")
    learner = made.learner
    assert isinstance(learner, GreedyRollout)
    policy, baseline = learner.modules["policy"], learner.modules["baseline"]

    def apart() -> float:
        pairs = zip(policy.parameters(), baseline.parameters(), strict=True)
        return max(float((a - b).detach().abs().max()) for a, b in pairs)

    gaps = []
    for _ in range(4):
        learner.learn(made.collector.collect(learner.policy, 1), 0.0, np.random.default_rng(0))
        gaps.append(apart())
    assert [gap > 0 for gap in gaps] == [True, False, True, False]


def test_all_copies_of_an_instance_meet_the_same_noise_and_updates_other_instances():
    collector = parts("env.options.durations=stochastic").collector
    assert isinstance(collector, SequenceCollector)
    simulator = collector.simulator()
    identities = [instance.identity for instance in simulator.instances]
    assert len(set(identities[:3])) == len(set(identities[3:])) == 1 != len(set(identities))
    true = simulator.state.pairs["true"]
    np.testing.assert_array_equal(true[:3], true[:1].repeat(3, axis=0))
    collector.restore({"updates": np.array([1])})
    assert {instance.identity for instance in collector.simulator().instances}.isdisjoint(identities)


def test_a_network_that_draws_no_sequences_is_refused(tmp_path: Path):
    with pytest.raises(InvalidOptionError, match="networks that draw sequences"):
        build(
            RunRecord(
                config=load_config(["env=murse", "algorithm=greedy_rollout", "curriculum=rounds", "device=cpu"]),
                overrides=[],
                revision="",
            )
        )

"""The ablation's baseline: rewards-to-go less a value of the state node and the time left."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.domain import get_domain
from marl_sched.train.algorithms.state_value import TIME_LEFT, StateValue, StateValueBaseline, TimedEpisodes
from marl_sched.train.collect import Rollout
from marl_sched.train.config import RunRecord, load_config
from marl_sched.train.export import knowledge
from marl_sched.train.ppo import samples_of
from tests.train.playing import changed, task

LENGTH = 20


@pytest.fixture(scope="module")
def policy() -> HetGATNetwork:
    torch.manual_seed(0)
    return HetGATNetwork(get_domain("airme").simulator(get_domain("airme").instances("small", 1, 0)).graph, width=2)


@pytest.fixture(scope="module")
def rollout(policy: HetGATNetwork) -> Rollout:
    playing = task(rows=4, episodes=2, turns=None, view={"kind": "full"}, options={"scheme": "single"})
    return TimedEpisodes(playing).collect(policy, LENGTH)


class Hourly(nn.Module):
    """Says that every hour left is worth one half."""

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        return observation[TIME_LEFT] / 2


def test_advantages_are_what_an_episode_still_earns_less_the_critics_value(rollout: Rollout):
    estimate = StateValueBaseline(Hourly(), discount=1.0).estimate(rollout)
    for row in range(4):
        taken = [t for t in range(rollout.actions.shape[0]) if rollout.valid[t, row]]
        for t in taken:
            # the last turn's reward may reach beyond the cut, by the hours in which no crew was free
            earned = 0.0
            for later in taken:
                if later >= t:
                    passed, hour = int(rollout.elapsed[later, row]), int(rollout.times[later, row])
                    earned += float(rollout.rewards[later, row]) * min(passed, LENGTH - hour) / max(passed, 1)
            assert estimate.value_targets[t, row] == pytest.approx(earned)
            expected = earned - (LENGTH - int(rollout.times[t, row])) / 2
            assert estimate.advantages[t, row] == pytest.approx(expected)
    assert estimate.loss_mask.equal(rollout.valid)


def test_turns_that_do_not_count_touch_nothing(rollout: Rollout, policy: HetGATNetwork):
    assert (~rollout.valid).any()
    clean, dirty = (
        samples_of(
            policy, played, StateValueBaseline(Hourly(), discount=0.9).estimate(played), 1.0, np.random.default_rng(0)
        )
        for played in (rollout, changed(rollout, ~rollout.valid, torch.nan, ("next", "reward")))
    )
    for name in ("advantage", "value_target"):
        assert torch.isfinite(clean[name]).all()
        assert torch.equal(clean[name], dirty[name])


def test_critic_reads_the_time_left_and_the_state_node_but_sums_no_nodes(rollout: Rollout, policy: HetGATNetwork):
    torch.manual_seed(1)
    critic = StateValue(policy.spec, width=4, heads=2, layers=2)
    assert not critic.critic.node_terms
    for parameter in critic.parameters():
        nn.init.normal_(parameter)
    seen = rollout.data[:, 0].to_dict()
    before = critic(seen)
    assert not torch.allclose(critic({**seen, TIME_LEFT: seen[TIME_LEFT] - 5}), before)
    assert not torch.allclose(critic({**seen, "state": seen["state"] + 1}), before)


def recorded(*overrides: str) -> RunRecord:
    return RunRecord(config=load_config(overrides), overrides=list(overrides), revision="")


def test_card_says_that_the_critic_was_told_the_time_left():
    assert knowledge(recorded("algorithm=state_value", "view=local")) == "a critic that is told the time left"


@pytest.mark.parametrize(("algorithm", "used"), [("gae", "a critic on the full graph"), ("ippo", "")])
def test_card_of_a_policy_trained_on_random_views_says_whether_the_critic_saw_more(algorithm: str, used: str):
    assert knowledge(recorded(f"algorithm={algorithm}", "view=random")) == used

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import torch

from marl_sched.agents.base import AdvantageScheduler
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.policies.cards import read_card
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidOptionError
from marl_sched.train.algorithms.imitation import Imitation, ImitationConfig, cross_entropy, expected_advantage
from marl_sched.train.collect import Rollout
from marl_sched.train.run import train_from_overrides
from tests.train.playing import LOCAL, segment

CONFIG = ImitationConfig(
    instances=6, turns=20, teacher="none", criterion="cross_entropy", epochs=1, minibatch=64,
    learning_rate=1e-2, final_learning_rate=1e-2,
    temperature=0.1, final_temperature=0.1, max_grad_norm=1.0, min_keep_prob=1.0,
)  # fmt: skip


class Oldest(AdvantageScheduler):
    """Likes planes by their hours, less five; a true state of which it can be told."""

    name = "oldest"

    def choose(self, observation, uniform):
        return self.advantages(observation).argmax(1)

    def advantages(self, observation):
        gains = np.where(np.asarray(observation["action_mask"]) > 0, observation["plane"][..., 0] - 5.0, -np.inf)
        gains[:, 0] = 0.0
        return gains


def rollout(policy: HetGATNetwork, *, staleness: int = 0, turns: int = 20) -> Rollout:
    return segment(policy, rows=6, length=40, turns=turns, view={**LOCAL, "staleness": staleness})


@pytest.fixture
def policy() -> HetGATNetwork:
    torch.manual_seed(0)
    env = SchedulingTorchRL("airme", batch_size=1, horizon=10)
    return HetGATNetwork(env.simulator.graph, width=4, heads=2, layers=2)


def test_cross_entropy_is_that_of_the_wanted_distribution_and_ignores_illegal_targets() -> None:
    log_probs = torch.tensor([[0.25, 0.75, 0.0]]).log().clamp(min=torch.finfo(torch.float32).min)
    wanted = torch.tensor([[0.5, 0.5, 0.0]])
    expected = -(0.5 * np.log(0.25) + 0.5 * np.log(0.75))
    torch.testing.assert_close(cross_entropy(log_probs, wanted), torch.tensor([expected], dtype=torch.float32))


def test_what_a_choice_is_worth_is_its_mean_under_the_policy_and_the_entropy_at_its_temperature() -> None:
    log_probs = torch.tensor([[0.25, 0.75, 0.0]]).log().clamp(min=torch.finfo(torch.float32).min)
    entropy = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    expected = torch.tensor([0.25 * 2.0 - 0.75 + 0.1 * entropy], dtype=torch.float32)
    torch.testing.assert_close(expected_advantage(log_probs, torch.tensor([[2.0, -1.0, 9.0]]), 0.1), expected)


@pytest.mark.parametrize("criterion", ["cross_entropy", "expected_advantage"])
def test_a_policy_comes_to_choose_what_its_teacher_would(policy: HetGATNetwork, criterion: str) -> None:
    config = msgspec.structs.replace(CONFIG, criterion=criterion)
    learner, rng = Imitation(policy, Oldest(), config), np.random.default_rng(0)
    played = rollout(policy)
    regrets = [learner.learn(played, 0.0, rng)["regret"] for _ in range(60)]
    assert regrets[-1] < 0.3 * regrets[0]


class Idle(Oldest):
    """Never thinks a plane worth the work."""

    name = "idle"

    def advantages(self, observation):
        return np.where(np.arange(np.asarray(observation["action_mask"]).shape[1]) == 0, 0.0, -1.0)[None].repeat(
            len(observation["action_mask"]), 0
        )


def test_a_teacher_that_prefers_nothing_is_refused(policy: HetGATNetwork) -> None:
    learner = Imitation(policy, Idle(), CONFIG)
    with pytest.raises(InvalidOptionError, match=r"algorithm\.teacher: to idle no choice of .* turns is worth more"):
        learner.learn(rollout(policy), 0.0, np.random.default_rng(0))


def test_the_teacher_is_asked_about_the_true_state(policy: HetGATNetwork) -> None:
    asked: list[dict[str, np.ndarray]] = []

    class Listening(Oldest):
        def advantages(self, observation):
            asked.append(dict(observation))
            return super().advantages(observation)

    played = rollout(policy, staleness=12)
    Imitation(policy, Listening(), CONFIG).learn(played, 0.0, np.random.default_rng(0))
    in_turn = played.data.transpose(0, 1).flatten(0, 1)
    np.testing.assert_array_equal(asked[0]["plane"], in_turn["central", "plane"].numpy())
    assert not np.array_equal(asked[0]["plane"], in_turn["plane"].numpy())


TINY = [
    "policy.width=2", "policy.heads=2", "policy.layers=1", "validation.instances=2", "validation.length=20",
    "validation.every=2", "updates=2", "curriculum.start=20", "curriculum.stop=20",
]  # fmt: skip


def test_a_run_imitates_the_index_then_another_goes_on_from_its_policy(tmp_path) -> None:
    imitation = [*TINY, "algorithm=imitation", "algorithm.instances=4", "algorithm.turns=8"]
    first = train_from_overrides([*imitation, f"run_dir={tmp_path / 'a'}"], quiet=True)
    assert read_card(first / "policy.json").training_knowledge == "imitation of index-without-clock (failure model)"

    ppo = [*TINY, "algorithm.instances=4", "algorithm.turns=8", f"start_from={first / 'policy.safetensors'}"]
    second = train_from_overrides([*ppo, "view=local", f"run_dir={tmp_path / 'b'}"], quiet=True)
    told = read_card(second / "policy.json").training_knowledge
    assert told == "imitation of index-without-clock (failure model), a critic on the full graph"


def test_what_two_runs_in_a_row_have_used_is_told_once(tmp_path) -> None:
    imitation = [*TINY, "view=local", "algorithm=imitation", "algorithm.instances=4", "algorithm.turns=8"]
    first = train_from_overrides([*imitation, f"run_dir={tmp_path / 'a'}"], quiet=True)
    start = f"start_from={first / 'policy.safetensors'}"
    second = train_from_overrides([*imitation, start, f"run_dir={tmp_path / 'b'}"], quiet=True)
    told = [read_card(run / "policy.json").training_knowledge for run in (first, second)]
    assert told[0] == told[1] == "imitation of index-without-clock (failure model), the full graph for the teacher"


def test_a_network_of_other_sizes_cannot_be_gone_on_from(tmp_path) -> None:
    with pytest.raises(InvalidOptionError, match="start_from: expected a network of"):
        train_from_overrides([*TINY, "start_from=airme-full-profit", f"run_dir={tmp_path / 'a'}"], quiet=True)


def test_a_rule_that_scores_nothing_cannot_teach(tmp_path) -> None:
    overrides = [*TINY, "algorithm=imitation", "algorithm.teacher=corrective", f"run_dir={tmp_path / 'a'}"]
    with pytest.raises(InvalidOptionError, match=r"algorithm\.teacher"):
        train_from_overrides(overrides, quiet=True)


def test_a_teacher_that_plans_for_the_end_cannot_teach_episodes_that_are_cut_before_it(tmp_path) -> None:
    overrides = [*TINY, "algorithm=imitation", "algorithm.teacher=index", f"run_dir={tmp_path / 'a'}"]
    with pytest.raises(InvalidOptionError, match=r"algorithm\.teacher: .* does not heed the time left"):
        train_from_overrides(overrides, quiet=True)

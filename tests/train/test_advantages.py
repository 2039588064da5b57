"""Advantage estimators against numbers worked out by hand and against slow, plain implementations."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_sched.train.advantages import (
    generalised_advantages,
    normalised,
    own_turn_advantages,
    returns_by_time,
    step_baseline_advantages,
)

NAN = float("nan")


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)[:, None]


def test_a_turn_within_a_decision_epoch_discounts_nothing_and_one_that_passes_time_discounts_by_it():
    # Two turns in one decision epoch, the second lets 2 units pass. gamma = 1/2, lambda = 1.
    # delta_1 = 3 + 0.25 * 8 - 1 = 4; delta_0 = 0 + 1 * 1 - 2 = -1; A_1 = 4; A_0 = -1 + 1 * 4 = 3.
    advantages, targets = generalised_advantages(
        column(0, 3), column(0, 2), column(2, 1), column(1, 8), flags(0, 1), flags(0, 0), discount=0.5, gae_lambda=1.0
    )
    assert advantages[:, 0].tolist() == [3.0, 4.0]
    assert targets[:, 0].tolist() == [5.0, 5.0]


def test_the_trace_fades_with_simulated_time():
    # gamma = 1, lambda = 1/2, no values: A_2 = 8, A_1 = 4 + (1/2)^2 * 8 = 6, A_0 = 2 + (1/2)^0 * 6 = 8.
    none, zeros = flags(0, 0, 0), column(0, 0, 0)
    advantages, _ = generalised_advantages(
        column(2, 4, 8), column(0, 2, 1), zeros, zeros, flags(0, 0, 1), none, discount=1.0, gae_lambda=0.5
    )
    assert advantages[:, 0].tolist() == [8.0, 6.0, 8.0]


def test_an_end_is_worth_nothing_and_a_cut_is_worth_its_value():
    turns = (column(1, 1), column(1, 1), column(0, 0), column(0, 100), flags(0, 1))
    ended, _ = generalised_advantages(*turns, flags(0, 1), discount=0.5, gae_lambda=0.0)
    cut, _ = generalised_advantages(*turns, flags(0, 0), discount=0.5, gae_lambda=0.0)
    assert ended[:, 0].tolist() == [1.0, 1.0]
    assert cut[:, 0].tolist() == [1.0, 51.0]


def test_an_own_turn_lasts_until_the_agents_next_one_and_earns_what_the_team_does():
    # gamma = lambda = 1/2. Agents 0 and 1 act in hour 0, 0 again in hour 1, 1 in hour 3, 0 in hour 4, where the
    # segment ends.   turn:    0      1      2      3     (4)
    #                 agent    0      1      0      1      0
    #                 hours    0      1      2      1
    #                 reward   0      2      4      8
    # Agent 0, turn 2: earns 4 + 8/4 = 6 in 3 hours, target 6 + 40/8 = 11, advantage 11 - 3 = 8.
    #          turn 0: earns 0 + 2 = 2 in 1 hour, target 2 + 3/2 + (1/2)(1/2) 8 = 5.5, advantage 5.5 - 1 = 4.5.
    # Agent 1, turn 3 is its last: not learned from. Turn 1: earns 2 + 4/2 = 4 in 3 hours, target 4 + 16/8 = 6,
    #          advantage 6 - 5 = 1; nothing flows back from turn 3 but its value.
    advantages, targets, loss_mask = own_turn_advantages(
        column(0, 2, 4, 8), column(0, 1, 2, 1), column(1, 5, 3, 16), column(5, 3, 16, 40),
        torch.tensor([[0], [1], [0], [1]]), torch.tensor([[1], [0], [1], [0]]), flags(0, 0, 0, 1), flags(0, 0, 0, 0),
        discount=0.5, gae_lambda=0.5,
    )  # fmt: skip
    assert loss_mask[:, 0].tolist() == [True, True, True, False]
    assert advantages[:, 0].tolist() == [4.5, 1.0, 8.0, 0.0]
    assert targets[:, 0].tolist() == [5.5, 6.0, 11.0, 0.0]


def test_no_own_turn_is_lost_where_an_episode_ends_and_none_reaches_over_its_cut():
    # Turn 1 of row 0 is an end, of row 1 a cut at which agent 1 was to act. After it another episode begins. gamma 1.
    # Row 0: both turns run to the end. Agent 0 earns 1 + 2, agent 1 earns 2.
    # Row 1: agent 1 has the value of the cut, 2 + 7; agent 0 has no future that is known.
    agents = torch.tensor([[0, 0], [1, 1], [0, 1]])
    next_agents = torch.tensor([[1, 1], [-1, 1], [0, 0]])
    boundary = torch.tensor([[0, 0], [1, 1], [1, 1]]).bool()
    terminated = torch.tensor([[0, 0], [1, 0], [0, 0]]).bool()
    rewards = torch.tensor([[1.0, 1.0], [2.0, 2.0], [100.0, 100.0]])
    values, next_values = torch.zeros(3, 2), torch.tensor([[0.0, 0.0], [NAN, 7.0], [1000.0, 1000.0]])
    advantages, _, loss_mask = own_turn_advantages(
        rewards, torch.ones(3, 2, dtype=torch.int64), values, next_values, agents, next_agents, boundary, terminated,
        discount=1.0, gae_lambda=1.0,
    )  # fmt: skip
    assert loss_mask.T.tolist() == [[True, True, True], [False, True, False]]
    assert advantages.T.tolist() == [[3.0, 2.0, 1100.0], [0.0, 9.0, 0.0]]


def drawn(seed: int, agents: int) -> dict[str, torch.Tensor]:
    """Random turns (30, 5) with ends and cuts; values without a future are NaN."""
    rng = np.random.default_rng(seed)
    shape = (30, 5)
    boundary = rng.random(shape) < 0.15
    boundary[-1] = True
    terminated = boundary & (rng.random(shape) < 0.4)
    who, heir = rng.integers(0, agents, shape), rng.integers(0, agents, shape)
    heir[:-1] = np.where(boundary[:-1], heir[:-1], who[1:])
    values, following = rng.normal(size=shape), rng.normal(size=shape)
    following[:-1] = np.where(boundary[:-1], following[:-1], values[1:])
    found = {
        "rewards": rng.normal(size=shape),
        "elapsed": rng.integers(0, 4, shape),
        "values": values,
        "next_values": np.where(terminated, NAN, following),
        "agents": who,
        "next_agents": np.where(terminated, -1, heir),
        "boundary": boundary,
        "terminated": terminated,
    }
    return {name: torch.from_numpy(array) for name, array in found.items()}


def test_one_agents_own_turns_are_the_teams():
    turns, factors = drawn(4, 1), {"discount": 0.9, "gae_lambda": 0.7}
    own = own_turn_advantages(**turns, **factors)
    team = generalised_advantages(
        **{name: value for name, value in turns.items() if not name.endswith("agents")}, **factors
    )
    assert own[2].all()
    torch.testing.assert_close(own[:2], team)


@pytest.mark.parametrize("seed", range(20))
def test_own_turns_agree_with_a_plain_walk_from_turn_to_turn(seed: int):
    turns, discount, gae_lambda = drawn(seed, 1 + seed % 4), 0.9, 0.8
    rewards, elapsed, values, following, who, heir, boundary, terminated = (v.numpy() for v in turns.values())
    expected, loss_mask = np.zeros((2, *rewards.shape)), np.zeros(rewards.shape, bool)
    for t, row in reversed(list(np.ndindex(rewards.shape))):
        earned, passed, later, future, credit, known = 0.0, 0, t, 0.0, 0.0, False
        while True:
            earned += discount**passed * rewards[later, row]
            passed += elapsed[later, row]
            if boundary[later, row]:
                mine = heir[later, row] == who[t, row]
                known = mine or terminated[later, row]
                future = following[later, row] if mine else 0.0
                break
            later += 1
            if who[later, row] == who[t, row]:
                known, future, credit = True, values[later, row], gae_lambda**passed * expected[0, later, row]
                break
        loss_mask[t, row] = known
        if known:
            target = earned + discount**passed * (future + credit)
            expected[:, t, row] = target - values[t, row], target
    found = own_turn_advantages(**turns, discount=discount, gae_lambda=gae_lambda)
    assert found[2].numpy().tolist() == loss_mask.tolist()
    np.testing.assert_allclose(np.stack([found[0], found[1]]), expected, atol=1e-12)


def test_nothing_reaches_over_a_cut_into_the_next_episode():
    # Turn 0 is cut: its target is 1 + 6/2 whatever the next episode brings.
    advantages, _ = generalised_advantages(
        column(1, 1000), column(1, 1), column(0, 0), column(6, 0), flags(1, 1), flags(0, 0),
        discount=0.5, gae_lambda=1.0,
    )  # fmt: skip
    assert advantages[:, 0].tolist() == [4.0, 1000.0]


def test_the_value_of_what_an_end_led_to_may_be_nan():
    advantages, targets = generalised_advantages(
        column(2), column(1), column(0), column(NAN), flags(1), flags(1), discount=0.9, gae_lambda=0.9
    )
    assert advantages[:, 0].tolist() == targets[:, 0].tolist() == [2.0]


def test_rewards_to_go_spread_a_turn_over_the_time_it_lets_pass():
    # Turns at times 0 (2 units, reward 4) and 2 (1 unit, reward 1): hourly 2, 2, 1, gamma = 1/2.
    returns = returns_by_time(
        column(4, 1), torch.tensor([[2], [1]]), torch.tensor([[0], [2]]), flags(1, 1), discount=0.5, length=4
    )
    assert returns[:, 0].tolist() == [2 + 0.5 * 2.5, 2 + 0.5, 1.0, 0.0]


def test_rewards_beyond_the_length_are_left_out():
    returns = returns_by_time(column(4), torch.tensor([[4]]), torch.tensor([[0]]), flags(1), discount=1.0, length=3)
    assert returns[:, 0].tolist() == [3.0, 2.0, 1.0]


def test_the_step_baseline_is_the_mean_at_the_same_time_over_episodes_of_the_instance():
    # Rows 0, 1 share an instance, rows 2, 3 another. One turn each at time 0, row 1 takes two turns there.
    rewards = torch.tensor([[1.0, 0.0, 10.0, 30.0], [NAN, 5.0, NAN, NAN]], dtype=torch.float64)
    elapsed = torch.tensor([[1, 0, 1, 1], [1, 1, 1, 1]])
    times = torch.zeros(2, 4, dtype=torch.int64)
    valid = torch.tensor([[1, 1, 1, 1], [0, 1, 0, 0]], dtype=torch.bool)
    advantages = step_baseline_advantages(rewards, elapsed, times, valid, discount=0.9, length=1, episodes=2)
    assert advantages.tolist() == [[-2.0, 2.0, -10.0, 10.0], [0.0, 2.0, 0.0, 0.0]]


def test_step_baseline_agrees_with_a_plain_loop_over_hours():
    rng = np.random.default_rng(0)
    length, rows, discount = 12, 6, 0.8
    hourly = rng.random((length, rows))
    returns = np.zeros((length + 1, rows))
    for t in reversed(range(length)):
        returns[t] = hourly[t] + discount * returns[t + 1]
    expected = returns[:-1].reshape(length, 2, 3)
    expected = (expected - expected.mean(axis=2, keepdims=True)).reshape(length, rows)
    advantages = step_baseline_advantages(
        torch.from_numpy(hourly),
        torch.ones(length, rows, dtype=torch.int64),
        torch.arange(length)[:, None].expand(length, rows),
        torch.ones(length, rows, dtype=torch.bool),
        discount=discount,
        length=length,
        episodes=3,
    )
    assert advantages.numpy() == pytest.approx(expected, abs=1e-12)


def test_normalised_advantages_have_mean_zero_and_deviation_one_over_valid_turns_alone():
    scaled = normalised(torch.tensor([[1.0, NAN], [3.0, 5.0]]), torch.tensor([[True, False], [True, True]]))
    assert scaled[0, 1] == 0.0
    loss_mask = torch.stack([scaled[0, 0], scaled[1, 0], scaled[1, 1]])
    assert loss_mask.mean().item() == pytest.approx(0.0, abs=1e-6)
    assert loss_mask.std(correction=0).item() == pytest.approx(1.0, abs=1e-6)

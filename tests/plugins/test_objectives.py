"""An objective from outside pays the rewards, scores the schedulers and tells its parts."""

import json

import pytest


@pytest.mark.parametrize("name", ["strain", "couriers.objectives:Strain"])
def test_rewards_and_their_parts_sum_to_the_total_in_aec_and_parallel(installed, name):
    """The score is minus the return per day; both APIs take the same choices: idle until the end."""
    from marl_sched.envs.api.aec import SchedulingAEC
    from marl_sched.envs.api.parallel import SchedulingParallel

    turns = SchedulingAEC("couriers", scale="town", objective=name)
    turns.reset(seed=2)
    paid, parts = 0.0, {"waiting": 0.0, "travel": 0.0}
    while turns.simulator.acting[0] >= 0:
        mask = turns.last()[0]["action_mask"]
        turns.step(int(mask.nonzero()[0][-1]))
        paid += turns.rewards[turns.agents[0]]
        for part, value in turns.infos[turns.agent_selection]["reward_parts"].items():
            parts[part] += value
    days = int(turns.simulator.time[0])
    assert paid == pytest.approx(sum(parts.values()), abs=1e-12)
    assert turns.simulator.objectives()[name][0] == pytest.approx(-paid / days)
    assert parts["waiting"] == pytest.approx(-days * turns.simulator.objectives()["waiting"][0])
    assert parts["travel"] == pytest.approx(-days * turns.simulator.objectives()["travel"][0] / 2)
    assert parts["travel"] < 0

    together = SchedulingParallel("couriers", scale="town", objective=name)
    together.reset(seed=2)
    while together.agents:
        _, rewards, _, _, infos = together.step(dict.fromkeys(together.agents, 0))
        told = next(iter(infos.values()))["reward_parts"]
        assert sum(told.values()) == pytest.approx(next(iter(rewards.values())))


def test_a_joint_step_pays_what_the_turns_that_it_covers_would(installed):
    """Both play the same first test episode, everybody doing nothing: the returns and their parts are equal."""
    import gymnasium
    import numpy as np

    from marl_sched import gymnasium_ids
    from marl_sched.envs.api.aec import SchedulingAEC

    gymnasium_ids.register()
    options = {"scale": "town", "objective": "strain", "split": "test"}
    central = gymnasium.make("marl_sched/Couriers-v0", **options)
    central.reset(seed=2)
    paid, parts, over = 0.0, {"waiting": 0.0, "travel": 0.0}, False
    while not over:
        _, reward, terminated, truncated, info = central.step(np.zeros_like(central.action_space.nvec))
        paid, over = paid + reward, terminated or truncated
        assert sum(info["reward_parts"].values()) == pytest.approx(reward)
        parts = {name: part + info["reward_parts"][name] for name, part in parts.items()}
    turns = SchedulingAEC("couriers", **options)
    turns.reset(seed=2)
    expected = 0.0
    while turns.simulator.acting[0] >= 0:
        turns.step(0)
        expected += turns.rewards[turns.agents[0]]
    assert paid == pytest.approx(expected)
    assert paid == pytest.approx(sum(parts.values()))
    assert parts["waiting"] < 0 == parts["travel"]


def test_it_is_an_objective_of_the_command_line(run, tmp_path):
    command = ("evaluate", "--env", "couriers", "--schedulers", "nearest", "--instances", 2, "--episodes", 1)
    ended = run(*command, "--objective", "strain", "--json", tmp_path / "r.json")
    assert ended.code == 0, ended.err
    row = json.loads((tmp_path / "r.json").read_text())["schedulers"]["nearest"]
    assert row["M1"] == row["strain"]
    assert row["strain"]["mean"] == pytest.approx(row["waiting"]["mean"] + row["travel"]["mean"] / 2)
    refused = run(*command, "--objective", "fame")
    assert "unknown objective of couriers 'fame'" in refused.err
    assert "strain" in refused.err

"""The same seed and the same choices give the same trace through every environment API, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.gymnasium_env import SchedulingEnv

HORIZON = {"airme": 60, "murse": 3, "ward": 5}  # hours, rounds, hours
SEED = 11
ROW, BATCH = 17, 64


def flat(observation):
    """A PettingZoo observation as bytes by array name."""
    arrays = {**observation["observation"], "action_mask": observation["action_mask"]}
    return {name: array.tobytes() for name, array in arrays.items()}


@pytest.fixture(params=(0, 1, 2))
def instance(domain, request):
    return domain.instances("small", 3, SEED)[request.param]


@pytest.fixture
def trace(domain, view, instance, pick, bits):
    """An AEC episode: one dict per turn."""
    env = SchedulingAEC(domain, instance=instance, view=view, horizon=HORIZON[domain.name])
    env.reset(seed=SEED)
    turns = []
    while not any(env.terminations.values()) and not any(env.truncations.values()):
        turn = {"agent": env.agent_selection, "time": int(env.simulator.time[0]), "seen": flat(env.last()[0])}
        turn["before"] = bits(env.simulator.snapshot(0))
        turn["action"] = pick(env.last()[0]["action_mask"], len(turns))
        env.step(turn["action"])
        turn["reward"] = env.rewards[env.agents[0]]
        turn["after"] = bits(env.simulator.snapshot(0))
        turns.append(turn)
    assert len(turns) > 20
    assert sum(turn["action"] > 0 for turn in turns) > 5
    return turns


@pytest.mark.parametrize(("row", "batch"), [(0, 1), (ROW, BATCH)])
def test_aec_and_torchrl_agree(domain, view, instance, trace, bits, row, batch):
    torch = pytest.importorskip("torch")
    from torchrl.envs import step_mdp

    from marl_sched.envs.api.torchrl_env import SchedulingTorchRL

    instances = domain.instances("small", batch, SEED + 1)
    instances[row] = instance
    env = SchedulingTorchRL(domain, instances=instances, view=view, horizon=HORIZON[domain.name], seed=SEED)
    td = env.reset()
    for turn in trace:
        assert domain.agent_name(int(td["acting"][row])) == turn["agent"]
        assert {name: td[name][row].numpy().tobytes() for name in env.simulator.arrays} == turn["seen"]
        td = env.rand_action(td)
        td["action"] = td["action"].index_put((torch.tensor(row),), torch.tensor(turn["action"]))
        td = step_mdp(env.step(td), exclude_reward=False)
        assert td["reward"][row].item() == turn["reward"]
        assert bits(env.simulator.snapshot(row)) == turn["after"]
    assert td["done"][row].item()


@pytest.mark.parametrize("domain", ["airme"], indirect=True)
@pytest.mark.parametrize("view", ["full"], indirect=True)
def test_aec_and_gymnasium_agree(domain, instance, trace, bits):
    env = SchedulingEnv(domain, instance=instance, horizon=HORIZON[domain.name])
    observation, _ = env.reset(seed=SEED)
    turns = iter(trace)
    turn = next(turns)
    paid = 0.0
    for hour in range(HORIZON[domain.name]):
        action = np.zeros(env.simulator.max_agents, np.int64)
        if turn is not None and turn["time"] == hour:
            # AEC lets the hours pass in which all crews are busy; what a step brought is not part of the state.
            paid = 0.0
            assert {name: array.tobytes() for name, array in observation.items()} == turn["seen"]
            state, expected = bits(env.simulator.snapshot(0)), dict(turn["before"])
            for book in ("rows.reward", "rows.elapsed"):
                del state[book], expected[book]
            assert state == expected
        while turn is not None and turn["time"] == hour:
            action[int(turn["agent"].split("_")[1])] = turn["action"]
            reward, turn = turn["reward"], next(turns, None)
        observation, hourly, terminated, truncated, info = env.step(action)
        assert info["illegal"] == []
        paid += hourly
        if turn is not None and turn["time"] == hour + 1:
            assert paid == reward
    assert truncated
    assert not terminated
    assert turn is None
    assert paid == reward

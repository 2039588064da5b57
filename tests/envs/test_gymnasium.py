from __future__ import annotations

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import marl_sched
from marl_sched.envs.api.gymnasium_env import SchedulingEnv
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError
from tests.envs.problems import HORIZON, fleet

IDS = {"airme": "marl_sched/AirME-v0", "murse": "marl_sched/MuRSE-v0", "ward": "marl_sched/Ward-v0"}


def make(domain, **options):
    return SchedulingEnv(domain, **{"horizon": HORIZON[getattr(domain, "name", domain)], **options})


def test_passes_gymnasiums_checker_under_its_registered_name(domain):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(IDS[domain.name], horizon=HORIZON[domain.name]).unwrapped)


def test_importing_the_package_registers_the_environments():
    program = (
        "import marl_sched, gymnasium; assert {'marl_sched/AirME-v0', 'marl_sched/MuRSE-v0'} <= set(gymnasium.registry)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    assert marl_sched.__all__


def test_every_observation_lies_in_its_space(domain, padded):
    env = make(domain, instance=padded)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=1)
    over = False
    while not over:
        assert env.observation_space.contains(observation)
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        over = terminated or truncated
    assert env.observation_space.contains(observation)


def test_an_episode_repeats_to_the_last_bit(domain):
    def trace(seed):
        env = make(domain)
        env.action_space.seed(0)
        observation, info = env.reset(seed=seed)
        out = [info]
        over = False
        while not over:
            out += [array.tobytes() for array in observation.values()]
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            out.append((reward, terminated, truncated, info))
            over = terminated or truncated
        return out

    assert trace(5) == trace(5)
    assert trace(5) != trace(6)


def test_reset_without_a_seed_goes_on_to_the_next_episode(domain):
    env = make(domain)
    env.reset(seed=4)
    first = env.simulator.instances[0].identity
    env.reset()
    assert env.simulator.instances[0].identity != first
    env.reset(seed=4)
    assert env.simulator.instances[0].identity == first


def test_one_step_of_airme_is_one_hour_even_while_all_crews_are_busy():
    env = make("airme", scale=None, instance=fleet(5, 2))
    env.reset(seed=1)
    for hour in range(1, 4):
        observation, reward, _, _, info = env.step(np.array([1, 2]))
        assert info == {"time": hour, "illegal": []}
        assert reward == env.simulator.state.series[0, hour - 1, 0]
        # A repair takes at least 2 + 24 // 24 + 0 hours, of which the decision's own is the first.
        if hour < 3:
            assert env.simulator.acting[0] == -1
            assert observation["crew_mask"].tolist() == [1, 1]
            assert observation["action_mask"].tolist() == [1, 0, 0, 0, 0, 0]


def test_illegal_parts_of_an_action_idle_their_crews():
    env = make("airme", instance=fleet(5, 6))
    env.reset(seed=1)
    # crew 1 repeats the choice of crew 0, crew 2 wants a plane that is not of this fleet, crews 6 and 7 do not exist
    *_, info = env.step(np.array([1, 1, 6, 2, 0, 3, 9, 9]))
    assert info["illegal"] == [1, 2]
    assert env.simulator.state.crews["plane"][0].tolist() == [1, 0, 0, 2, 0, 3, 0, 0]
    *_, info = env.step(np.array([0, 2, 0, 0, 0, 0, 0, 0]))  # plane 2 is in the hands of crew 3
    assert info["illegal"] == [1]


def test_under_skip_the_first_idle_decision_ends_the_hours_decisions():
    env = make("airme", scale=None, instance=fleet(5, 4), scheme="skip")
    env.reset(seed=1)
    *_, info = env.step(np.array([1, 0, 1, 3]))
    assert env.simulator.state.crews["plane"][0].tolist() == [1, 0, 0, 0]
    assert info["illegal"] == []


def test_under_single_only_the_first_free_crew_decides():
    env = make("airme", scale=None, instance=fleet(5, 4), scheme="single")
    env.reset(seed=1)
    env.step(np.array([1, 2, 3, 4]))
    assert env.simulator.state.crews["plane"][0].tolist() == [1, 0, 0, 0]
    env.step(np.array([1, 2, 3, 4]))
    assert env.simulator.state.crews["plane"][0].tolist() == [1, 2, 0, 0]


def test_the_end_is_told_and_enforced():
    env = make("airme", horizon=2)
    env.reset(seed=1)
    idle = np.zeros(8, int)
    assert env.step(idle)[2:4] == (False, False)
    assert env.step(idle)[2:4] == (False, True)
    with pytest.raises(IllegalActionError, match="over"):
        env.step(idle)


@pytest.mark.parametrize("action", [np.zeros(3, int), np.full(8, 99), np.full(8, -1), 3, np.zeros(8)])
def test_an_action_outside_the_space_raises(action):
    env = make("airme")
    env.reset(seed=1)
    with pytest.raises(IllegalActionError, match=r"joint action: expected one in MultiDiscrete"):
        env.step(action)


def test_the_central_face_has_no_view(domain):
    with pytest.raises(InvalidOptionError, match="view"):
        make(domain, view="local")


def test_unknown_options_raise(domain):
    with pytest.raises(TypeError, match="heigth"):
        make(domain, heigth=3)
    with pytest.raises(UnknownNameError, match="reset option"):
        make(domain).reset(options={"sede": 3})


def test_render_modes_draw(domain):
    for mode in domain.render:
        env = gymnasium.make(IDS[domain.name], horizon=HORIZON[domain.name], render_mode=mode)
        env.reset(seed=1)
        env.step(env.action_space.sample())
        assert env.render() is not None

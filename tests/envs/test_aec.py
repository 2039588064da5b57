from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import api_test, seed_test
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from marl_sched import airme_v0
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError
from tests.envs.problems import HORIZON


def make(domain, **options):
    return SchedulingAEC(domain, **{"horizon": HORIZON[getattr(domain, "name", domain)], **options})


def play(env, pick):
    """Play an episode that was just reset; yields (agent, last(), action) at every turn, dead steps included."""
    for turn, agent in enumerate(env.agent_iter()):
        last = env.last()
        action = None if last[2] or last[3] else pick(last[0]["action_mask"], turn)
        yield agent, last, action
        env.step(action)


def test_passes_pettingzoos_api_test(domain, view, only_mask_warnings):
    api_test(OrderEnforcingWrapper(make(domain, view=view)), num_cycles=60)


def test_passes_pettingzoos_seed_test(domain, only_mask_warnings):
    seed_test(lambda: make(domain), num_cycles=20)


def test_the_public_module_passes_pettingzoos_api_test(only_mask_warnings):
    api_test(airme_v0.env(horizon=HORIZON["airme"]), num_cycles=60)


def test_every_observation_lies_in_its_space(domain, view, padded, pick):
    env = make(domain, view=view, instance=padded)
    env.reset(seed=1)
    for agent, (observation, *_), _ in play(env, pick):
        assert env.observation_space(agent).contains(observation)
        assert env.observation_space(agent).contains(env.observe(env.agents[-1]))
        assert env.state_space.contains(env.state())


def test_every_array_has_the_dtype_of_its_space(domain, pick):
    env = make(domain)
    env.reset(seed=1)
    for agent, (observation, *_), _ in play(env, pick):
        for name, space in env.observation_space(agent)["observation"].items():
            assert observation["observation"][name].dtype == space.dtype


def test_agents_are_the_instances_and_spaces_the_scales(domain, padded):
    env = make(domain, instance=padded)
    env.reset(seed=1)
    assert env.agents == env.possible_agents[: len(env.agents)]
    assert len(env.agents) < len(env.possible_agents)
    assert env.action_space(env.agents[0]).n == env.simulator.max_actions
    observation = env.observe(env.agent_selection)
    own = domain.simulator([padded], view=env.simulator.view)
    assert not observation["action_mask"][own.max_actions :].any()


def test_agents_stay_the_same_until_all_end_together(domain, pick):
    env = make(domain)
    env.reset(seed=3)
    agents = list(env.agents)
    ended = 0
    for _, (_, _, terminated, truncated, _), _ in play(env, pick):
        if terminated or truncated:
            ended += 1
            assert all(env.terminations[a] or env.truncations[a] for a in env.agents)
        else:
            assert env.agents == agents
            assert ended == 0
    assert ended == len(agents)
    assert env.agents == []


def test_only_agents_with_a_decision_are_selected(domain, pick):
    env = make(domain)
    env.reset(seed=3)
    for agent, (_, _, terminated, truncated, _), _ in play(env, pick):
        if not (terminated or truncated):
            assert int(agent.split("_")[1]) in env.simulator.free_agents(0)


def test_rewards_read_by_any_one_agent_sum_to_the_return(domain, pick):
    env = make(domain)
    env.reset(seed=2)
    paid, read = 0.0, dict.fromkeys(env.agents, 0.0)
    for turn, agent in enumerate(env.agent_iter()):
        observation, reward, terminated, truncated, _ = env.last()
        read[agent] += reward
        if terminated or truncated:
            env.step(None)
        else:
            env.step(pick(observation["action_mask"], turn))
            assert set(env.rewards.values()) == {env.simulator.reward[0]}
            paid += env.simulator.reward[0]
    assert paid != 0.0
    for agent in read:
        assert read[agent] == pytest.approx(paid, abs=1e-12)


def test_the_return_is_the_objective_times_the_hours(pick):
    env = make("airme", objective="availability")
    env.reset(seed=2)
    returns = 0.0
    for agent, (_, reward, *_), _ in play(env, pick):
        if agent == "crew_2":
            returns += reward
    assert returns == pytest.approx(env.simulator.objectives()["availability"][0] * HORIZON["airme"], abs=1e-12)


def test_no_reward_is_paid_while_others_act_at_the_same_decision_epoch():
    env = make("airme")
    env.reset(seed=2)
    n = len(env.agents)
    for agent in env.agents[:-1]:
        assert env.agent_selection == agent
        env.step(0)
        assert set(env.rewards.values()) == {0.0}
    env.step(0)
    assert set(env.rewards.values()) != {0.0}
    assert env.simulator.time[0] == 1
    assert len(env.agents) == n


def test_the_horizon_truncates_and_the_share_of_broken_planes_terminates():
    env = make("airme", horizon=2)
    env.reset(seed=1)
    while env.simulator.acting[0] >= 0:
        env.step(0)
    assert set(env.truncations.values()) == {True}
    assert set(env.terminations.values()) == {False}
    env = make("airme", horizon=500, stop_share=0.3)
    env.reset(seed=1)
    while env.simulator.acting[0] >= 0:
        env.step(0)
    assert set(env.terminations.values()) == {True}
    assert set(env.truncations.values()) == {False}


def test_an_episode_repeats_to_the_last_bit(domain, view, pick):
    def trace(seed):
        env = make(domain, view=view)
        env.reset(seed=seed)
        out = []
        for agent, (observation, reward, terminated, truncated, info), action in play(env, pick):
            arrays = {**observation["observation"], "action_mask": observation["action_mask"]}
            out.append((agent, reward, terminated, truncated, info["conflict"], info["time"], action))
            out.append({name: array.tobytes() for name, array in arrays.items()})
        return out

    assert trace(5) == trace(5)
    assert trace(5) != trace(6)


def test_reset_without_a_seed_goes_on_to_the_next_episode(domain):
    env, other = make(domain, split="test"), make(domain, split="test", seed=4)
    env.reset(seed=4)
    other.reset()
    first = env.simulator.instances[0].identity
    assert other.simulator.instances[0].identity == first
    assert env.simulator.episode_keys[0] == other.simulator.episode_keys[0]
    env.reset()
    second = env.simulator.instances[0].identity
    assert second != first
    assert second == domain.generate("small", np.random.default_rng([4, 1])).identity
    env.reset(seed=4)
    assert env.simulator.instances[0].identity == first


def test_a_fixed_instance_gets_new_noise_in_every_episode(domain, padded):
    env = make(domain, instance=padded)
    keys = set()
    for _ in range(3):
        env.reset()
        assert env.simulator.instances[0].identity == padded.identity
        keys.add(int(env.simulator.episode_keys[0]))
    assert len(keys) == 3


def test_an_instance_given_to_reset_is_played_once(domain, padded, tmp_path):
    padded.save(tmp_path / "instance.json")
    env = make(domain)
    for given in (padded, tmp_path / "instance.json", str(tmp_path / "instance.json")):
        env.reset(seed=1, options={"instance": given})
        assert env.simulator.instances[0].identity == padded.identity
        env.reset()
        assert env.simulator.instances[0].identity != padded.identity


def test_a_masked_choice_raises_and_leaves_the_turn_to_be_taken(domain, pick, bits):
    env = make(domain)
    env.reset(seed=1)
    for turn in range(5):
        env.step(pick(env.last()[0]["action_mask"], turn))
    agent, mask = env.agent_selection, env.last()[0]["action_mask"]
    forbidden = int(np.flatnonzero(mask == 0)[0])
    before = bits(env.simulator.snapshot(0))
    with pytest.raises(IllegalActionError, match=rf"{agent}: action {forbidden} is not legal at time \d+; legal: 0"):
        env.step(forbidden)
    assert env.agent_selection == agent
    assert bits(env.simulator.snapshot(0)) == before
    env.step(0)


@pytest.mark.parametrize("action", [-1, 10_000, 1.0, None, "1"])
def test_a_choice_outside_the_space_raises(domain, action):
    env = make(domain)
    env.reset(seed=1)
    with pytest.raises(IllegalActionError, match=env.agent_selection):
        env.step(action)


def test_stepping_after_the_end_raises(domain, pick):
    env = make(domain, horizon=3)
    env.reset(seed=1)
    for _ in play(env, pick):
        pass
    with pytest.raises(IllegalActionError, match="over"):
        env.step(0)


def test_after_the_end_no_action_but_0_is_legal(domain, pick):
    env = make(domain)
    env.reset(seed=1)
    for _, (observation, _, terminated, truncated, info), _ in play(env, pick):
        if terminated or truncated:
            assert observation["action_mask"].sum() == observation["action_mask"][0] == 1
            np.testing.assert_array_equal(info["action_mask"], observation["action_mask"])


def test_info_repeats_the_mask_and_says_what_is_seen(domain, view, pick):
    env = make(domain, view=view)
    env.reset(seed=1)
    shares = []
    for _, (observation, *_, info), _ in play(env, pick):
        assert set(info) == {"action_mask", "conflict", "time", "visible_share"}
        np.testing.assert_array_equal(info["action_mask"], observation["action_mask"])
        assert info["time"] == env.simulator.time[0] == observation["observation"]["time"]
        shares.append(info["visible_share"])
    assert (min(shares) < 1) == (view == "local")


def test_a_crew_with_an_old_picture_meets_a_conflict_and_is_told():
    env = make("airme", view={"kind": "local", "reach": 8, "comm": 0, "staleness": 6})
    env.reset(seed=1)
    env.step(1)  # crew 0 takes plane 1, which crew 1 cannot know
    assert env.agent_selection == "crew_1"
    assert env.last()[0]["action_mask"][1] == 1
    env.step(1)
    assert env.infos["crew_1"]["conflict"]
    while env.agent_selection != "crew_1":
        assert not env.infos[env.agent_selection]["conflict"]
        env.step(0)
    assert env.last()[4]["conflict"]
    assert env.simulator.state.crews["plane"][0, 1] == 0


def test_observations_already_handed_out_do_not_change(domain, pick):
    env = make(domain)
    env.reset(seed=1)
    seen = env.last()[0]
    copies = {name: array.copy() for name, array in seen["observation"].items()}
    for turn in range(20):
        env.step(pick(env.last()[0]["action_mask"], turn))
    for name, array in seen["observation"].items():
        np.testing.assert_array_equal(array, copies[name])


@pytest.mark.parametrize("make_env", [airme_v0.raw_env, airme_v0.parallel_env])
def test_spaces_of_agents_that_cannot_be_are_refused_by_name(make_env):
    env = make_env()
    for space in (env.action_space, env.observation_space):
        with pytest.raises(UnknownNameError, match="unknown agent 'crew_99'"):
            space("crew_99")


@pytest.mark.parametrize("make_env", [airme_v0.env, airme_v0.raw_env, airme_v0.parallel_env])
def test_unknown_options_raise(make_env):
    with pytest.raises(TypeError, match="heigth"):
        make_env(heigth=3)
    with pytest.raises(TypeError, match="scheme"):
        make_env(scheme="skip")
    with pytest.raises(UnknownNameError, match="did you mean 'local'"):
        make_env(view="lokal")
    with pytest.raises(UnknownNameError, match="did you mean 'small'"):
        make_env(scale="smal")
    with pytest.raises(UnknownNameError, match="render mode"):
        make_env(render_mode="human")
    with pytest.raises(InvalidOptionError, match="instance: expected AirmeInstance or a file's path, got int"):
        make_env(instance=3)
    with pytest.raises(InvalidOptionError, match="seed"):
        make_env(seed=-1)
    with pytest.raises(InvalidOptionError, match=r"view local: .*radius"):
        make_env(view={"kind": "local", "radius": 2})


def test_unknown_reset_options_raise(domain):
    with pytest.raises(UnknownNameError, match="did you mean 'instance'"):
        make(domain).reset(options={"instnace": 1})


def test_schemes_are_refused_where_every_free_agent_decides(domain):
    with pytest.raises(InvalidOptionError, match="scheme"):
        make(domain, scheme="skip")


def test_an_instance_may_set_the_padding(domain, padded):
    env = make(domain, scale=None, instance=padded)
    env.reset()
    assert env.agents == env.possible_agents
    with pytest.raises(InvalidOptionError, match="scale"):
        make(domain, scale=None)


def test_every_render_mode_draws(domain, pick):
    for mode in domain.render:
        env = make(domain, render_mode=mode)
        env.reset(seed=1)
        for turn in range(10):
            env.step(pick(env.last()[0]["action_mask"], turn))
        picture = env.render()
        if mode == "ansi":
            assert isinstance(picture, str)
            assert picture
        else:
            assert picture.dtype == np.uint8
            assert picture.shape[2] == 3
    with pytest.raises(InvalidOptionError, match="render_mode"):
        make(domain).render()


def test_the_example_of_the_page_runs(monkeypatch):
    page = airme_v0.__doc__
    example = page.split("```python\n")[1].split("```")[0].replace('scale="small", ', 'scale="small", horizon=5, ')
    scope: dict[str, object] = {}
    exec(example, scope)  # noqa: S102 (the package's own documentation)
    assert scope["env"].agents == []

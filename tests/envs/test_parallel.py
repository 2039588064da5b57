from __future__ import annotations

import warnings

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError
from marl_sched.noise import Stream, time_key, uniform
from tests.envs.problems import HORIZON, fleet


def make(domain, **options):
    return SchedulingParallel(domain, **{"horizon": HORIZON[getattr(domain, "name", domain)], **options})


def winner(env, action, agents):
    """Who has the action by the rule, worked out from the noise alone."""
    time_word = np.uint64(time_key(env.simulator.episode_keys[0], env.simulator.time[0]))
    draws = {agent: uniform(time_word, int(Stream.CONFLICT), action, agent) for agent in agents}
    return min(draws, key=draws.__getitem__)


def test_passes_pettingzoos_parallel_api_test(domain, view, largest_crew, only_mask_warnings):
    # An instance with fewer agents than the padding makes the kit warn that possible agents never came alive.
    parallel_api_test(make(domain, view=view, instance=largest_crew), num_cycles=60)


def test_passes_the_parallel_api_test_with_padded_agents(domain, padded):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="No agents present but not all possible_agents are terminated")
        parallel_api_test(make(domain, instance=padded), num_cycles=60)


def test_passes_pettingzoos_parallel_seed_test(domain, only_mask_warnings):
    parallel_seed_test(lambda: make(domain), num_cycles=20)


def test_an_episode_repeats_to_the_last_bit(domain, view, pick):
    def trace(seed):
        env = make(domain, view=view)
        observations, infos = env.reset(seed=seed)
        out = []
        for turn in range(1000):
            out += [array.tobytes() for seen in observations.values() for array in seen["observation"].values()]
            actions = {a: pick(observations[a]["action_mask"], turn + i) for i, a in enumerate(env.agents)}
            observations, rewards, terminated, truncated, infos = env.step(actions)
            out.append((rewards, terminated, truncated, [info["conflict"] for info in infos.values()]))
            if not env.agents:
                return out
        raise AssertionError("the episode does not end")

    assert trace(5) == trace(5)
    assert trace(5) != trace(6)


def test_every_observation_lies_in_its_space(domain, view, padded, pick):
    env = make(domain, view=view, instance=padded)
    observations, _ = env.reset(seed=1)
    turn = 0
    while env.agents:
        for agent, seen in observations.items():
            assert env.observation_space(agent).contains(seen)
        actions = {a: pick(observations[a]["action_mask"], turn + i) for i, a in enumerate(env.agents)}
        observations, *_ = env.step(actions)
        turn += 1
    assert all(seen["action_mask"].sum() == 1 for seen in observations.values())


def test_of_all_who_choose_one_action_the_smallest_draw_has_it():
    env = make("airme", scale=None, instance=fleet(6, 4))
    won = set()
    for seed in range(12):
        env.reset(seed=seed)
        best = winner(env, 3, [0, 1, 3])
        infos = env.step({"crew_0": 3, "crew_1": 3, "crew_2": 5, "crew_3": 3})[-1]
        assert env.simulator.state.planes["crew"][0, 3] == best
        assert env.simulator.state.planes["crew"][0, 5] == 2
        assert {agent for agent, info in infos.items() if info["conflict"]} == (
            {"crew_0", "crew_1", "crew_3"} - {f"crew_{best}"}
        )
        assert not any(info["illegal"] for info in infos.values())
        won.add(best)
    assert won == {0, 1, 3}


def mix_by_hand(x):
    """The finaliser of SplitMix64 on Python integers, from the paper's constants, of `x` modulo 2**64."""
    word = (1 << 64) - 1
    x &= word
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & word
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & word
    return x ^ (x >> 31)


def test_the_draw_is_that_of_its_definition_for_keys_of_all_sizes():
    def by_hand(key, time, action, agent):
        time_word = mix_by_hand((key ^ time) + 0x9E3779B97F4A7C15)
        name = (int(Stream.CONFLICT) << 56) | (agent << 40) | action
        return mix_by_hand(time_word + (name + 1) * 0x9E3779B97F4A7C15) >> 11

    env = make("airme", scale=None, instance=fleet(6, 4))
    high = 0
    for seed in (*range(100), *(2**63 - 1 - 3**k for k in range(39))):
        env.reset(seed=seed)
        key, time = int(env.simulator.episode_keys[0]), int(env.simulator.time[0])
        high += key >= 2**63
        env.step(dict.fromkeys(env.agents, 5))
        assert env.simulator.state.planes["crew"][0, 5] == min(range(4), key=lambda a: by_hand(key, time, 5, a))
    assert 40 < high < 100


STALE = {"kind": "local", "reach": 2, "comm": 0, "staleness": 6}


def test_losers_of_an_action_learn_what_they_would_in_aec(bits):
    from marl_sched.envs.api.aec import SchedulingAEC

    options = {"scale": None, "instance": fleet(6, 4), "view": STALE}
    env, aec = make("airme", **options), SchedulingAEC("airme", horizon=HORIZON["airme"], **options)
    won = set()
    for seed in range(12):
        env.reset(seed=seed)
        best = winner(env, 3, [0, 1, 3])
        observations, *_, infos = env.step({"crew_0": 3, "crew_1": 3, "crew_2": 0, "crew_3": 3})
        losers = {0, 1, 3} - {best}
        for loser in losers:
            seen = observations[f"crew_{loser}"]
            assert infos[f"crew_{loser}"]["conflict"]
            assert seen["action_mask"][3] == 0  # somebody has it in hand
            assert env.simulator.state.private_memory_at[0, loser, 3] == 0
            assert env.simulator.state.private_memory["chosen"][0, loser, 3] == best
        won.add(best)
        if best == 0:  # AEC's turns come in the same order
            aec.reset(seed=seed)
            for action in (3, 3, 0, 3):
                aec.step(action)
            for _ in range(5):
                assert env.simulator.time[0] == aec.simulator.time[0]
                assert bits(env.simulator.snapshot(0)) == bits(aec.simulator.snapshot(0))
                for loser in losers:
                    mine, theirs = observations[f"crew_{loser}"], aec.simulator.observe(np.array([loser]))
                    for name, array in mine["observation"].items():
                        np.testing.assert_array_equal(array, theirs[name][0], err_msg=name)
                free = env.simulator.free_agents(0)
                observations, *_ = env.step(dict.fromkeys(env.agents, 0))
                for _ in free:
                    aec.step(0)
    assert won == {0, 1, 3}


def test_losers_in_murse_idle_a_unit_and_know_who_has_the_task():
    env = make("murse", mode="online")
    observations, _ = env.reset(seed=3)
    free = env.simulator.free_agents(0).tolist()
    assert len(free) > 1
    legal = np.all([observations[env.agents[i]]["action_mask"] for i in free], axis=0)
    action = int(np.flatnonzero(legal)[1])
    best = winner(env, action, free)
    infos = env.step(dict.fromkeys(env.agents, action))[-1]
    state = env.simulator.state
    assert state.tasks["agent"][0, action - 1] == best
    assert {agent for agent, info in infos.items() if info["conflict"]} == {env.agents[i] for i in free if i != best}
    assert state.rows["conflicts"][0] == len(free) - 1
    assert env.simulator.time[0] == 1
    assert all((state.private_memory[0, i, action - 1] >= 0).all() for i in free if i != best)


def test_an_agent_that_has_acted_is_given_no_second_turn(domain):
    env = make(domain)
    env.reset(seed=1)
    simulator = env.simulator
    first, last = simulator.free_agents(0)[[0, -1]]
    simulator.give_turn(0, last)
    assert simulator.acting[0] == last
    simulator.step(np.array([0]))
    assert simulator.acting[0] == first
    with pytest.raises(IllegalActionError, match=f"row 0: agent {last} has no turn at time 0"):
        simulator.give_turn(0, last)


def test_idling_together_is_no_conflict():
    env = make("airme", scale=None, instance=fleet(6, 4))
    env.reset(seed=1)
    infos = env.step(dict.fromkeys(env.agents, 0))[-1]
    assert not any(info["conflict"] or info["illegal"] for info in infos.values())


def test_an_illegal_choice_idles_its_agent_alone():
    env = make("airme", scale=None, instance=fleet(6, 3), view={"kind": "local", "reach": 0, "comm": 0})
    observations, _ = env.reset(seed=1)
    assert observations["crew_0"]["action_mask"].nonzero()[0].tolist() == [0, 1, 4]
    infos = env.step({"crew_0": 2, "crew_1": 2, "crew_2": 0})[-1]
    assert infos["crew_0"]["illegal"]
    assert not infos["crew_0"]["conflict"]
    assert not infos["crew_1"]["illegal"]
    assert not infos["crew_1"]["conflict"]
    assert env.simulator.state.planes["crew"][0, 2] == 1
    assert env.simulator.state.crews["plane"][0, :3].tolist() == [0, 2, 0]


def test_actions_of_busy_agents_are_ignored():
    env = make("airme", scale=None, instance=fleet(6, 2))
    env.reset(seed=1)
    env.step({"crew_0": 1, "crew_1": 0})
    assert env.simulator.state.crews["plane"][0].tolist() == [1, 0]
    infos = env.step({"crew_0": 5, "crew_1": 0})[-1]
    assert not infos["crew_0"]["illegal"]
    assert env.simulator.state.crews["plane"][0].tolist() == [1, 0]
    env.step({"crew_1": 0})  # a busy agent needs no action
    assert env.simulator.time[0] == 3


def test_time_passes_until_somebody_is_free():
    env = make("airme", scale=None, instance=fleet(6, 2))
    env.reset(seed=1)
    _, rewards, *_ = env.step({"crew_0": 1, "crew_1": 2})
    simulator = env.simulator
    assert simulator.time[0] > 1
    assert simulator.free_agents(0).size > 0
    profit = simulator.state.series[0, : simulator.time[0], 0]
    assert rewards["crew_0"] == rewards["crew_1"] == pytest.approx(profit.sum(), abs=1e-12)


def test_rewards_of_any_agent_sum_to_the_objective(domain, pick):
    env = make(domain)
    observations, _ = env.reset(seed=3)
    agent, total, turn = env.agents[-1], 0.0, 0
    while env.agents:
        actions = {a: pick(observations[a]["action_mask"], turn + i) for i, a in enumerate(env.agents)}
        observations, rewards, *_ = env.step(actions)
        assert len(set(rewards.values())) == 1
        total += rewards[agent]
        turn += 1
    assert total != 0.0
    if domain.name == "airme":
        assert total == pytest.approx(env.simulator.objectives()["profit"][0] * HORIZON["airme"], abs=1e-12)


def test_choices_that_do_not_meet_give_the_trace_of_aec(bits):
    from marl_sched.envs.api.aec import SchedulingAEC

    parallel, aec = make("airme"), SchedulingAEC("airme", horizon=HORIZON["airme"])
    observations, _ = parallel.reset(seed=4)
    aec.reset(seed=4)
    while parallel.agents:
        # Crew i keeps to the planes p with p mod n = i, so that no two want the same.
        n = len(parallel.agents)
        actions = {}
        for i, agent in enumerate(parallel.agents):
            own = [t for t in np.flatnonzero(observations[agent]["action_mask"]) if t > 0 and t % n == i]
            actions[agent] = own[0] if own else 0
        for i in parallel.simulator.free_agents(0):
            assert aec.agent_selection == f"crew_{i}"
            aec.step(actions[f"crew_{i}"])
        observations, rewards, *_ = parallel.step(actions)
        assert set(rewards.values()) == set(aec.rewards.values())
        assert bits(parallel.simulator.snapshot(0)) == bits(aec.simulator.snapshot(0))


def test_errors_come_before_anything_happens(domain, bits):
    env = make(domain)
    env.reset(seed=1)
    before = bits(env.simulator.snapshot(0))
    idle = dict.fromkeys(env.agents, 0)
    first = env.agents[0]
    with pytest.raises(IllegalActionError, match=f"{first}: action 10000: expected one in"):
        env.step(idle | {first: 10_000})
    with pytest.raises(IllegalActionError, match=f"{first}: expected an integer action, got 0.5"):
        env.step(idle | {first: 0.5})
    with pytest.raises(UnknownNameError, match="agent 'nobody'"):
        env.step(idle | {"nobody": 0})
    with pytest.raises(IllegalActionError, match=f"{first}: is free and has no action"):
        env.step({agent: 0 for agent in env.agents if agent != first})
    assert bits(env.simulator.snapshot(0)) == before


def test_stepping_after_the_end_raises():
    env = make("airme", horizon=1)
    env.reset(seed=1)
    env.step(dict.fromkeys(env.agents, 0))
    assert env.agents == []
    with pytest.raises(IllegalActionError, match="over"):
        env.step({})


def test_reset_without_a_seed_goes_on_to_the_next_episode(domain):
    env = make(domain)
    env.reset(seed=4)
    first = env.simulator.instances[0].identity
    env.reset()
    assert env.simulator.instances[0].identity != first
    env.reset(seed=4)
    assert env.simulator.instances[0].identity == first


def test_schemes_are_refused_where_every_free_agent_decides(domain):
    with pytest.raises(InvalidOptionError, match="scheme"):
        make(domain, scheme="single")


def test_renders_as_the_domain_does(domain):
    env = make(domain, render_mode="ansi")
    env.reset(seed=1)
    assert env.render() == domain.render["ansi"](env.simulator, 0)

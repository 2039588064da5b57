"""What PettingZoo's, Gymnasium's and TorchRL's usual tools expect of an environment."""

from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest

from marl_sched import airme_v0, murse_v0, ward_v0
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.gymnasium_env import SchedulingEnv
from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.errors import UnknownNameError
from tests.envs.problems import HORIZON

PAGES = {"airme": airme_v0, "murse": murse_v0, "ward": ward_v0}


@pytest.fixture(params=(SchedulingAEC, SchedulingParallel))
def kind(request):
    return request.param


def play(env, pick, turns=60):
    """Play from a reset; yields agent, observation, info, reward and action at every turn of AEC."""
    env.reset(seed=1)
    for turn in range(turns):
        observation, reward, terminated, truncated, info = env.last()
        if terminated or truncated:
            return
        action = pick(observation["action_mask"], turn)
        yield env.agent_selection, observation, info, reward, action
        env.step(action)


def test_a_padded_team_is_the_same_in_every_episode(domain, kind):
    env = kind(domain, pad_agents=True, horizon=2)
    teams, sizes = set(), set()
    for seed in range(8):
        env.reset(seed=seed)
        teams.add(tuple(env.agents))
        sizes.add(int(env.simulator.n_agents[0]))
    assert teams == {tuple(env.possible_agents)}
    assert len(sizes) > 1  # of the instances themselves


def test_absent_members_of_a_padded_team_see_nothing_and_can_only_do_nothing(domain, kind, padded):
    env = kind(domain, instance=padded, pad_agents=True, horizon=2)
    env.reset(seed=1)
    nodes = f"{domain.agent_prefix}_mask"
    for i, agent in enumerate(env.agents):
        seen = env.observe(agent)
        absent = i >= env.simulator.n_agents[0]
        assert env.observation_space(agent).contains(seen)
        assert (seen["observation"][nodes].sum() == 0) == absent
        if absent:
            assert seen["action_mask"].tolist() == [1] + [0] * (env.simulator.max_actions - 1)


def test_padding_the_team_changes_nothing_for_those_who_are_there(domain, padded, pick):
    plain, full = (SchedulingAEC(domain, instance=padded, horizon=2, pad_agents=p) for p in (False, True))
    for first, second in zip(play(plain, pick, 500), play(full, pick, 500), strict=True):
        assert (first[0], first[3], first[4]) == (second[0], second[3], second[4])
        for name, array in first[1]["observation"].items():
            np.testing.assert_array_equal(array, second[1]["observation"][name])
    assert any(full.terminations.values()) or any(full.truncations.values())
    while full.agents:  # every member ends, the absent ones too
        full.step(None)


def test_a_parallel_step_of_a_padded_team_answers_every_member(domain, padded):
    env = SchedulingParallel(domain, instance=padded, pad_agents=True, horizon=2)
    env.reset(seed=1)
    for returned in env.step(dict.fromkeys(env.agents, 0)):
        assert list(returned) == env.possible_agents


@pytest.mark.parametrize("mask", ["both", "observation", "info"])
@pytest.mark.parametrize("flat", [False, True])
def test_the_mask_is_where_the_option_says(domain, kind, mask, flat):
    env = kind(domain, mask=mask, flat=flat, horizon=2)
    env.reset(seed=1)
    agent = env.agent_selection if kind is SchedulingAEC else env.agents[0]
    seen, info = env.observe(agent), env.infos[agent] if kind is SchedulingAEC else env.reset(seed=1)[1][agent]
    assert env.observation_space(agent).contains(seen)
    graph = seen if mask == "info" else seen["observation"]
    assert isinstance(graph, np.ndarray) == flat
    assert ("action_mask" in info) == (mask != "observation")
    assert (isinstance(seen, dict) and "action_mask" in seen) == (mask != "info")
    if mask == "both":
        np.testing.assert_array_equal(info["action_mask"], seen["action_mask"])


def test_an_unknown_place_of_the_mask_is_refused(domain, kind):
    with pytest.raises(UnknownNameError, match="did you mean 'info'"):
        kind(domain, mask="infos")


def test_a_flat_observation_holds_all_arrays_in_their_order(domain, view, pick):
    env, flat = (SchedulingAEC(domain, view=view, flat=f, horizon=2) for f in (False, True))
    for first, second in zip(play(env, pick), play(flat, pick), strict=True):
        vector = second[1]["observation"]
        assert vector.dtype == np.float32
        whole = np.concatenate([array.astype(np.float32).ravel() for array in first[1]["observation"].values()])
        np.testing.assert_array_equal(vector, whole)


def test_flat_gymnasium_spaces_are_one_dimensional(domain):
    env = SchedulingEnv(domain, flat=True, horizon=HORIZON[domain.name])
    observation, _ = env.reset(seed=1)
    assert env.observation_space.shape == observation.shape
    assert observation.ndim == env.action_space.nvec.ndim == 1
    env.action_space.seed(0)
    over = False
    while not over:
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        over = terminated or truncated


def test_flat_and_other_gymnasium_environments_play_alike(domain):
    plain, flat = (SchedulingEnv(domain, flat=f, horizon=2) for f in (False, True))
    plain.reset(seed=1), flat.reset(seed=1)
    flat.action_space.seed(0)
    for _ in range(2):
        action = flat.action_space.sample()
        assert flat.step(action)[1:] == plain.step(action.reshape(plain.action_space.shape))[1:]


def allowed(env):
    """The masks of an environment's joint action, part by part."""
    masks = env.action_masks()
    nvec = env.action_space.nvec.ravel()
    assert masks.dtype == bool
    assert masks.shape == (nvec.sum(),)
    return np.split(masks, np.cumsum(nvec)[:-1])


def test_the_mask_of_airmes_joint_action_is_what_each_crew_could_do_alone():
    """Every action of one crew while the others idle: it is marked illegal just where the mask forbids it."""
    env = SchedulingEnv("airme", flat=True, horizon=6)
    env.reset(seed=2)
    busy = 0
    for _ in range(4):
        saved = env.save_state()
        available = env.simulator.free_agents(0).tolist()
        for crew, part in enumerate(allowed(env)):
            free = crew in available
            busy += not free
            for action in range(0, len(part), 5):
                env.load_state(saved)
                *_, info = env.step(np.eye(1, len(env.action_space.nvec), crew, dtype=np.int64)[0] * action)
                assert part[action] == (action == 0 or (free and crew not in info["illegal"]))
        env.load_state(saved)
        env.step(np.array([np.flatnonzero(part)[-1] for part in allowed(env)]))
    assert busy > 0


def test_the_mask_of_murses_joint_action_is_the_instances_tasks_and_agents(padded):
    if not hasattr(padded, "n_tasks"):
        pytest.skip("an AirME instance")
    env = SchedulingEnv("murse", instance=padded, horizon=1)
    env.reset(seed=1)
    for slots, agents in zip(allowed(env)[::2], allowed(env)[1::2], strict=True):
        assert slots.sum() == padded.n_tasks + 1
        assert slots[: padded.n_tasks + 1].all()
        assert agents.tolist() == [i < padded.n_agents for i in range(env.simulator.max_agents)]


def test_registered_environments_take_the_flat_layout(domain):
    name = {"airme": "marl_sched/AirME-v0", "murse": "marl_sched/MuRSE-v0", "ward": "marl_sched/Ward-v0"}[domain.name]
    env = gymnasium.make(name, flat=True, horizon=2)
    assert env.get_wrapper_attr("action_masks")().shape == (env.action_space.nvec.sum(),)


class TestTorchRL:
    @pytest.fixture(autouse=True)
    def torch(self):
        return pytest.importorskip("torch")

    @pytest.mark.parametrize("flat", [False, True])
    @pytest.mark.parametrize("module", PAGES)
    @pytest.mark.parametrize(("api", "mask"), [("raw_env", "observation"), ("parallel_env", "observation"),
                                               ("parallel_env", "info")])  # fmt: skip
    def test_pettingzoo_wrapper_takes_a_padded_team_across_episodes(self, module, api, mask, flat):
        from torchrl.envs.libs.pettingzoo import PettingZooWrapper

        made = getattr(PAGES[module], api)(horizon=1, pad_agents=True, mask=mask, flat=flat)
        env = PettingZooWrapper(made, use_mask=api == "raw_env")
        rollout = env.rollout(40, break_when_any_done=False)
        assert rollout["next", "done"].sum() > 0

    def make(self, domain):
        from marl_sched.envs.api.torchrl_env import SchedulingTorchRL

        return SchedulingTorchRL(domain, batch_size=2, horizon=HORIZON[domain.name])

    def test_the_mask_transform_makes_random_rollouts_legal(self, domain):
        from torchrl.envs import TransformedEnv
        from torchrl.envs.transforms import ActionMask

        rollout = TransformedEnv(self.make(domain), ActionMask()).rollout(80, break_when_any_done=False)
        assert not rollout["next", "illegal"].any()
        assert rollout["next", "done"].any()

    def test_a_random_collector_runs_and_marks_what_was_illegal(self, domain):
        from torchrl.collectors import Collector

        collector = Collector(self.make(domain), None, frames_per_batch=200, total_frames=400)
        try:
            batches = list(collector)
        finally:
            collector.shutdown()
        assert [batch.numel() for batch in batches] == [200, 200]
        for batch in batches:
            chosen = batch["action_mask"].gather(-1, batch["action"].unsqueeze(-1)).squeeze(-1)
            assert (batch["next", "illegal"] == ~chosen).all()

    def test_a_serial_environment_runs_across_episodes(self, domain):
        from torchrl.envs import SerialEnv

        env = SerialEnv(2, lambda: self.make(domain))
        rollout = env.rollout(120, break_when_any_done=False)
        assert rollout["next", "done"].any()
        env.close()

    @pytest.mark.slow
    def test_a_parallel_environment_runs_across_episodes(self, domain):
        from torchrl.envs import ParallelEnv

        from marl_sched.envs.api.torchrl_env import SchedulingTorchRL

        make = partial(SchedulingTorchRL, domain.name, batch_size=2, horizon=HORIZON[domain.name])
        env = ParallelEnv(2, make)
        try:
            assert env.rollout(120, break_when_any_done=False)["next", "done"].any()
        finally:
            env.close()

    def test_torchrls_masked_categorical_takes_the_mask(self, domain, torch):
        from torchrl.modules import MaskedCategorical

        td = self.make(domain).reset()
        drawn = MaskedCategorical(logits=torch.zeros(td["action_mask"].shape), mask=td["action_mask"]).sample((50,))
        assert td["action_mask"].expand(50, -1, -1).gather(-1, drawn.unsqueeze(-1)).all()

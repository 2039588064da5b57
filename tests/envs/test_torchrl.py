from __future__ import annotations

import pickle  # noqa: TID251 (what is tested is that users may)
from copy import deepcopy

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tensordict import TensorDict  # noqa: E402
from torchrl.collectors import Collector  # noqa: E402
from torchrl.data.utils import _find_action_space  # noqa: E402
from torchrl.envs import TransformedEnv, step_mdp  # noqa: E402
from torchrl.envs.transforms import ActionMask, StepCounter  # noqa: E402
from torchrl.envs.utils import check_env_specs  # noqa: E402

from marl_sched.envs.api.torchrl_env import SchedulingTorchRL  # noqa: E402
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError  # noqa: E402
from tests.envs.problems import HORIZON  # noqa: E402


def make(domain, **options):
    return SchedulingTorchRL(
        domain, **{"horizon": HORIZON[getattr(domain, "name", domain)], "batch_size": 3, "seed": 0, **options}
    )


def advance(env, td, turns):
    for _ in range(turns):
        td = step_mdp(env.step(env.rand_action(td)))
    return td


def identities(env):
    return [instance.identity for instance in env.simulator.instances]


def test_passes_torchrls_check_of_specs(domain, view):
    check_env_specs(make(domain, view=view))


def test_passes_the_check_across_ends_of_episodes(domain):
    check_env_specs(make(domain, horizon=1), break_when_any_done=False)


def test_rollouts_without_a_policy_choose_legal_targets(domain):
    rollout = make(domain).rollout(80, break_when_any_done=False)
    legal = rollout["action_mask"].gather(-1, rollout["action"].unsqueeze(-1))
    assert legal.bool().all()
    assert rollout["next", "done"].any()
    assert len(rollout["action"].unique()) > 5


def test_random_choices_are_uniform_over_legal_actions():
    """Each of n legal actions is drawn about 4000 / n times: five standard deviations of a binomial are allowed."""
    env = make("airme", batch_size=4000, instances=None, scale="small")
    td = env.reset()
    chosen = torch.bincount(env.rand_action(td)["action"], minlength=env.simulator.max_actions)
    expected = (td["action_mask"] / td["action_mask"].sum(-1, keepdim=True)).sum(0)
    assert (chosen[expected == 0] == 0).all()
    assert ((chosen - expected).abs() <= 5 * expected.sqrt()).all()


@pytest.mark.parametrize(
    "handled",
    [lambda env: env, deepcopy, lambda env: pickle.loads(pickle.dumps(env))],  # noqa: S301
    ids=["itself", "copied", "pickled"],
)
def test_random_choices_are_legal_under_transforms(domain, handled):
    """A transformed environment draws from a clone of the action spec: the clone looks at the present mask, too."""
    env = TransformedEnv(make(domain), StepCounter())
    env.rollout(5)
    rollout = handled(env).rollout(80, break_when_any_done=False)
    assert rollout["action_mask"].gather(-1, rollout["action"].unsqueeze(-1)).all()
    assert not rollout["next", "illegal"].any()


def test_a_collector_without_a_policy_chooses_legal_actions(domain):
    (data,) = Collector(make(domain), None, frames_per_batch=90, total_frames=90)
    assert not data["next", "illegal"].any()


def test_the_action_spec_is_a_categorical_for_torchrl(domain):
    spec = make(domain).action_spec
    assert _find_action_space(spec) == "categorical"
    own = torch.zeros(3, spec.n, dtype=torch.bool)
    own[:, 2] = True
    narrowed = spec.clone()
    narrowed.update_mask(own)
    assert (narrowed.clone().rand((4,)) == 2).all()
    assert narrowed.rand((4,)).shape == (4, 3)
    assert spec.clone().mask.data_ptr() == spec.mask.data_ptr()


def test_the_mask_transform_serves_policies_that_sample_from_the_spec(domain):
    env = TransformedEnv(make(domain), ActionMask())
    td = env.reset()
    for _ in range(30):
        td["action"] = env.action_spec.rand()
        assert td["action_mask"].gather(-1, td["action"].unsqueeze(-1)).all()
        td = step_mdp(env.step(td))


def test_dtypes_and_shapes_are_those_of_the_page(domain):
    td = make(domain).rollout(5)["next"][:, -1]
    assert td["reward"].dtype == torch.float64
    assert td["reward"].shape == (3, 1)
    for name in ("done", "terminated", "truncated"):
        assert td[name].shape == (3, 1)
    for name, dtype in (
        ("acting", torch.int64),
        ("elapsed", torch.int64),
        ("conflict", torch.bool),
        ("illegal", torch.bool),
    ):
        assert td[name].shape == (3,)
        assert td[name].dtype == dtype


def test_reward_comes_with_the_time_that_passed(domain):
    env = make(domain, batch_size=2)
    td = env.reset()
    total, time = torch.zeros(2, 1, dtype=torch.float64), torch.zeros(2, dtype=torch.int64)
    while not td["done"].all():
        td = step_mdp(env.step(env.rand_action(td)), exclude_reward=False)
        total += td["reward"]
        time += td["elapsed"]
    assert (td["acting"] == -1).all()
    assert (total != 0).all()
    np.testing.assert_array_equal(time, env.simulator.time)
    if domain.name == "airme":
        np.testing.assert_allclose(
            total[:, 0] / HORIZON["airme"], env.simulator.objectives()["profit"], rtol=0, atol=1e-12
        )


def test_resetting_some_rows_leaves_the_others_untouched(domain, bits):
    env = make(domain)
    td = advance(env, env.reset(), 15)
    before = [bits(env.simulator.snapshot(b)) for b in range(3)]
    marked = torch.tensor([[False], [True], [False]])
    after = env.reset(td.clone().set("_reset", marked))
    for b in (0, 2):
        assert bits(env.simulator.snapshot(b)) == before[b]
        for name in env.simulator.arrays:
            assert torch.equal(after[name][b], td[name][b])
    assert bits(env.simulator.snapshot(1)) != before[1]
    assert env.simulator.time.tolist()[1] == 0
    advance(env, after, 5)


def test_rows_that_end_start_again_alone(domain, bits):
    env = make(domain)
    td = env.reset()
    ended = 0
    for _ in range(400):
        counts, times = env._count.copy(), env.simulator.time.copy()
        data, td = env.step_and_maybe_reset(env.rand_action(td))
        done = data["next", "done"][:, 0].numpy()
        np.testing.assert_array_equal(env._count, counts + done)
        assert (env.simulator.time[done] == 0).all()
        assert (env.simulator.time[~done] >= times[~done]).all()
        assert (data["next", "acting"][done] == -1).all()
        assert not td["done"].any()
        assert (td["acting"] >= 0).all()
        ended += int(done.sum())
        if done.any() and not done.all():
            fresh = env.simulator.observe(env.simulator.acting)
            for name, array in fresh.items():
                np.testing.assert_array_equal(td[name].numpy(), array)
    assert ended >= 3


def test_tensors_already_handed_out_do_not_change(domain):
    env = make(domain, horizon=5)
    td = env.reset()
    kept, copies = [], []
    for _ in range(20):
        data, td = env.step_and_maybe_reset(env.rand_action(td))
        kept.append(data)
        copies.append(data.clone())
    for data, copy in zip(kept, copies, strict=True):
        assert (data == copy).all()


def test_a_seed_repeats_a_rollout_to_the_last_bit(domain, view):
    env = make(domain, view=view)

    def trace(seed):
        env.set_seed(seed)
        torch.manual_seed(seed)
        return env.rollout(50, break_when_any_done=False)

    assert (trace(4) == trace(4)).all()
    first, other = trace(4), trace(5)
    assert not torch.equal(first["action"], other["action"])


def test_every_reset_goes_on_to_the_next_episode(domain):
    env = make(domain, batch_size=2)
    keys, rows = set(), None
    for _ in range(3):
        env.reset()
        keys.update(env.simulator.episode_keys.tolist())
        assert rows in (None, identities(env))
        rows = identities(env)
    assert len(keys) == 6
    env.set_seed(0)
    env.reset()
    assert set(env.simulator.episode_keys.tolist()) <= keys


def test_rows_that_share_an_instance_never_play_the_same_episode(domain):
    a, b = domain.instances("small", 2, seed=3)
    env = make(domain, batch_size=None, instances=[a, b, a, a])
    keys = []
    for _ in range(3):
        env.reset()
        keys += env.simulator.episode_keys.tolist()
    assert len(set(keys)) == len(keys)
    alone = make(domain, batch_size=None, instances=[b])
    alone.reset()
    alone.reset()
    assert alone.simulator.episode_keys[0] == keys[4 + 1]


def test_a_source_gives_new_instances_at_every_reset(domain):
    asked = []

    def source(row, number):
        asked.append((row, number))
        return domain.generate("small", np.random.default_rng([9, row, number]))

    env = make(domain, batch_size=2, source=source)
    del asked[:]
    env.reset()
    first = identities(env)
    td = env.reset()
    assert asked == [(0, 0), (1, 0), (0, 1), (1, 1)]
    assert not set(first) & set(identities(env))
    env.reset(td.set("_reset", torch.tensor([[False], [True]])))
    assert asked[-1] == (1, 2)
    assert len(asked) == 5


def test_a_choice_outside_the_space_raises_and_changes_nothing(domain, bits):
    env = make(domain)
    td = advance(env, env.reset(), 4)
    before = [bits(env.simulator.snapshot(b)) for b in range(3)]
    agent = domain.agent_name(int(td["acting"][1]))
    highest = env.simulator.max_actions - 1
    for action in (-1, highest + 1):
        td["action"] = torch.tensor([0, action, 0])
        with pytest.raises(
            IllegalActionError, match=rf"row 1: {agent}: action {action}: expected one in \[0, {highest}\]"
        ):
            env.step(td)
    assert [bits(env.simulator.snapshot(b)) for b in range(3)] == before


def test_an_illegal_choice_does_nothing_and_is_marked(domain, bits):
    env, twin = make(domain), make(domain)
    td, other = advance(env, env.reset(), 4), advance(twin, twin.reset(), 4)
    twin.load_state(env.save_state())
    td["action"] = torch.tensor([0, int(np.flatnonzero(td["action_mask"][1].numpy() == 0)[0]), 0])
    other["action"] = torch.tensor([0, 0, 0])
    assert env.step(td)["next", "illegal"].tolist() == [False, True, False]
    assert twin.step(other)["next", "illegal"].tolist() == [False, False, False]
    assert bits(env.simulator.snapshot(1)) == bits(twin.simulator.snapshot(1))


def test_rows_that_are_over_ignore_their_choice(domain):
    env = make(domain, batch_size=1, horizon=1)
    td = env.reset()
    while not td["done"].all():
        td = step_mdp(env.step(env.rand_action(td)))
    td["action"] = torch.tensor([env.simulator.max_actions - 1])
    assert env.step(td)["next", "reward"].item() == 0.0


def test_schemes_pass_through_to_the_simulator():
    env = make("airme", batch_size=1, scheme="single")
    td = env.reset()
    td["action"] = torch.tensor([1])
    td = env.step(td)["next"]
    assert td["elapsed"].tolist() == [1]


def test_a_padded_instance_hides_what_it_lacks(domain, padded):
    env = make(domain, batch_size=None, instances=[padded])
    own = domain.simulator([padded], view=env.simulator.view)
    rollout = env.rollout(20)
    assert not rollout["action_mask"][..., own.max_actions :].any()
    assert rollout["acting"].max() < own.max_agents


def test_works_under_torchrls_transforms(domain):
    env = TransformedEnv(make(domain, horizon=1), StepCounter())
    rollout = env.rollout(160, break_when_any_done=False)
    assert rollout["next", "done"].any()
    assert rollout["step_count"].max() < 159


def test_actions_are_made_without_a_tensordict(domain):
    env = make(domain)
    env.reset()
    action = env.rand_action()
    assert isinstance(action, TensorDict)
    assert env.action_spec.contains(action["action"])


def test_wrong_options_raise(domain):
    with pytest.raises(TypeError, match="heigth"):
        make(domain, heigth=3)
    with pytest.raises(UnknownNameError, match="did you mean 'small'"):
        make(domain, scale="smal")
    for batch_size in (None, 0):
        with pytest.raises(InvalidOptionError, match="batch_size"):
            make(domain, batch_size=batch_size)
    with pytest.raises(InvalidOptionError, match="instances: expected one per row"):
        make(domain, batch_size=3, instances=domain.instances("small", 2, seed=0))
    with pytest.raises(InvalidOptionError, match="source"):
        make(domain, instances=domain.instances("small", 3, seed=0), source=lambda row, number: None)
    with pytest.raises(InvalidOptionError, match="scale"):
        make(domain, scale=None)
    with pytest.raises(InvalidOptionError, match="seed"):
        make(domain).set_seed(-3)

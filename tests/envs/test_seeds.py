"""Train, validation and test problems never meet, and environments without a seed are not alike."""

from __future__ import annotations

import itertools

import gymnasium
import numpy as np
import pytest

from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.gymnasium_env import SchedulingEnv
from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.errors import UnknownNameError
from marl_sched.noise import SPLITS, episode_number, instance_generator

IDS = {"airme": "marl_sched/AirME-v0", "murse": "marl_sched/MuRSE-v0", "ward": "marl_sched/Ward-v0"}


def torchrl_env(domain, **options):
    module = pytest.importorskip("marl_sched.envs.api.torchrl_env")
    return module.SchedulingTorchRL(domain, batch_size=4, **options)


APIS = {"aec": SchedulingAEC, "parallel": SchedulingParallel, "gymnasium": SchedulingEnv, "torchrl": torchrl_env}


@pytest.fixture(params=APIS)
def make(request):
    return APIS[request.param]


def met(env, resets, seed=None):
    """Instances and keys of the noise of an environment's first episodes."""
    instances, keys = set(), set()
    for _ in range(resets):
        env.reset(seed=seed) if seed is not None else env.reset()
        seed = None
        instances |= {instance.identity for instance in env.simulator.instances}
        keys |= set(env.simulator.episode_keys.tolist())
    return instances, keys


def test_the_default_of_every_api_never_meets_what_evaluate_plays(domain, make):
    """`evaluate` plays `domain.instances(scale, count, seed)` with episodes 0, 1, ... of the same seed."""
    published = {i.identity for seed in range(3) for i in domain.instances("small", 30, seed)}
    for seed in range(3):
        instances, _ = met(make(domain, seed=seed), 8)
        assert not instances & published


def test_a_fixed_instance_meets_other_noise_in_every_split(domain, make):
    instance = domain.instances("small", 1, seed=0)[0]
    given = {"instances": [instance]} if make is torchrl_env else {"instance": instance}
    if make is torchrl_env:
        given["instances"] *= 4
    keys = [met(make(domain, split=split, seed=0, **given), 5)[1] for split in SPLITS]
    for first, second in itertools.combinations(keys, 2):
        assert not first & second


def test_the_test_split_begins_with_what_evaluate_plays_first(domain, make):
    env = make(domain, split="test", seed=7)
    env.reset()
    expected = domain.simulator(domain.instances("small", 4, seed=7), seed=7)
    assert env.simulator.instances[0].identity == expected.instances[0].identity
    assert env.simulator.episode_keys[0] == expected.episode_keys[0]


def test_published_instances_are_still_those_of_their_seed(domain):
    """What has been published was drawn by `default_rng([seed, i])`."""
    expected = [domain.generate("small", np.random.default_rng([3, i])).identity for i in range(4)]
    assert [instance.identity for instance in domain.instances("small", 4, seed=3)] == expected


@pytest.mark.parametrize("other", ["train", "validation"])
def test_no_seed_and_number_of_one_split_are_those_of_another(other):
    """A seed beyond 32 bits is two words to numpy, as are a small seed and a number: they must not be confused."""
    word = SPLITS[other]
    for seed, number in ((0, 0), (5, 1), (7, word), (2**32 + 3, 0)):
        drawn = instance_generator(seed, number, other).integers(0, 2**63, 4).tolist()
        for twin in ((seed, number), (seed + (number << 32), word), (seed + (word << 32), number)):
            assert instance_generator(*twin, "test").integers(0, 2**63, 4).tolist() != drawn


def test_episodes_of_different_splits_have_different_numbers():
    numbers = {episode_number(episode, split) for split in SPLITS for episode in range(1000)}
    assert len(numbers) == 3000
    assert [episode_number(e) for e in range(3)] == [0, 1, 2]


def test_an_unknown_split_is_refused(domain, make):
    with pytest.raises(UnknownNameError, match="unknown split 'exam'"):
        make(domain, split="exam")


def test_environments_without_a_seed_are_not_alike(domain, make):
    seen = [frozenset(met(make(domain), 1)[0]) for _ in range(4)]
    assert len(set(seen)) == 4


def test_vectorised_environments_without_a_seed_are_not_alike(domain):
    envs = gymnasium.make_vec(IDS[domain.name], num_envs=4, vectorization_mode="sync", horizon=2)
    observations, _ = envs.reset()
    name = {"airme": "plane", "murse": "task", "ward": "patient"}[domain.name]
    assert len({observations[name][i].tobytes() for i in range(4)}) == 4
    first, _ = envs.reset(seed=3)
    again, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(first[name], again[name])
    envs.close()


def test_the_trainers_instances_are_neither_validated_nor_evaluated_on():
    pytest.importorskip("torchrl")
    from marl_sched.domain import get_domain
    from marl_sched.problem import Problem
    from marl_sched.train.config import load_config
    from marl_sched.train.environment import InstanceSource
    from marl_sched.train.validation import Validation

    domain, seed = get_domain("airme"), 3
    config = load_config(["env=airme", "validation.instances=20", f"validation.seed={seed}", f"seed={seed}"])
    source = InstanceSource(Problem(domain, seed=seed, split="train"), ["small"], rows=20)
    trained = {source(row, 0).identity for row in range(20)}
    validated = {instance.identity for instance in Validation(config)._problems["small"].instances}
    evaluated = {instance.identity for instance in domain.instances("small", 20, seed)}
    assert len(trained | validated | evaluated) == 60

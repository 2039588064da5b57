from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.problem import Problem
from marl_sched.train.collect import EpisodeCollector, Rollout, SegmentCollector, WorkerCollector, segment_collector
from marl_sched.train.environment import InstanceSource
from tests.train.playing import task


@pytest.fixture(scope="module")
def policy() -> HetGATNetwork:
    torch.manual_seed(0)
    return HetGATNetwork(task().environment(0, 1).simulator.graph, width=2, heads=2, layers=1)


def source_of(scales: list[str], *, seed: int, rows: int) -> InstanceSource:
    return InstanceSource(Problem("airme", seed=seed, split="train"), scales, rows=rows)


def same(a: Rollout, b: Rollout) -> bool:
    entries = set(a.data.keys(True, True))
    assert entries == set(b.data.keys(True, True))
    return all(torch.equal(a.data[name], b.data[name]) for name in entries)


def test_the_training_environment_keeps_its_specs():
    check_env_specs(task(rows=2, central=True, memory=3).environment())


def test_whole_episodes_are_cut_at_the_length_in_every_row(policy: HetGATNetwork):
    rollout = EpisodeCollector(task(turns=None, length=20)).collect(policy, 20)
    valid = rollout.valid
    assert (rollout.times[valid] < 20).all()
    assert ((rollout.times + rollout.elapsed)[valid & rollout.boundary] >= 20).all()
    assert len(set(valid.sum(0).tolist())) > 1, "rows end at different decision counts"
    assert (valid[1:] <= valid[:-1]).all(), "a row does not come back"
    assert ((valid & rollout.boundary).sum(0) == 1).all()


def test_rows_that_share_an_instance_stand_side_by_side_and_differ_in_noise(policy: HetGATNetwork):
    collector = EpisodeCollector(task(rows=6, episodes=3, turns=None))
    rollout = collector.collect(policy, 20)
    identities = [instance.identity for instance in collector.env.simulator.instances]
    assert identities[0] == identities[1] == identities[2] != identities[3] == identities[4] == identities[5]
    assert not torch.equal(rollout.rewards[:, 0], rollout.rewards[:, 1])
    collector.collect(policy, 20)
    assert collector.env.simulator.instances[0].identity not in identities


def test_a_segment_goes_on_where_the_last_one_stopped(policy: HetGATNetwork):
    collector = SegmentCollector(task(turns=8, length=4000))
    first, second = collector.collect(policy, 4000), collector.collect(policy, 4000)
    assert torch.equal(first.data["next", "plane"][:, -1], second.data["plane"][:, 0])
    assert torch.equal(first.data["next", "time"][:, -1], second.data["time"][:, 0])
    assert first.valid.all()
    assert first.boundary[-1].all()
    assert not first.boundary[:-1].any()


def test_a_row_at_its_length_is_cut_with_a_future_and_begins_a_new_instance(policy: HetGATNetwork):
    collector = SegmentCollector(task(turns=60))
    rollout = collector.collect(policy, 8)
    first = [source_of(["small"], seed=3, rows=4)(row, 0).identity for row in range(4)]
    for row in range(4):
        cuts = rollout.boundary[:, row].nonzero().squeeze(1)
        assert len(cuts) > 1
        for number, cut in enumerate(cuts[:-1].tolist()):
            assert not rollout.terminated[cut, row]
            staggered = 8 * (row + 1) // 4
            assert rollout.data["next", "time"][row, cut] >= (8 if number else staggered)
            assert rollout.times[cut, row] < 8
            assert rollout.times[cut + 1, row] == 0
    assert not set(first) & {instance.identity for instance in collector.env.simulator.instances}


def test_choices_are_those_of_the_uniforms_in_the_tensordict(policy: HetGATNetwork):
    rollout = SegmentCollector(task(turns=10)).collect(policy, 8)
    names = [
        name for name in rollout.data.sorted_keys if not isinstance(rollout.data[name], type(rollout.data["next"]))
    ]
    states = rollout.data.select(*names).flatten(0, 1)
    with torch.no_grad():
        probs = policy(states).softmax(-1).double()
    below = torch.cat([torch.zeros(len(probs), 1, dtype=torch.float64), probs.cumsum(1)], 1)
    low, high = (below.gather(1, states["action"][:, None] + k).squeeze(1) for k in (0, 1))
    assert (low - 1e-5 <= states["uniform"]).all()
    assert (states["uniform"] <= high + 1e-5).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda: SegmentCollector(task(turns=24, length=12, central=True)),
        lambda: EpisodeCollector(task(turns=None, episodes=2, length=12)),
    ],
    ids=["segments", "episodes"],
)
def test_a_restored_collector_goes_on_exactly(
    make: Callable[[], SegmentCollector | EpisodeCollector], policy: HetGATNetwork
):
    collector, other = make(), make()
    for _ in range(3):
        collector.collect(policy, 12)
    other.restore(collector.state())
    assert same(collector.collect(policy, 12), other.collect(policy, 12))


def test_a_collector_that_was_saved_before_it_began_begins(policy: HetGATNetwork):
    collector, other = (SegmentCollector(task(turns=6)) for _ in range(2))
    other.restore(collector.state())
    assert same(collector.collect(policy, 8), other.collect(policy, 8))


@pytest.mark.slow
def test_workers_play_as_one_process_does(policy: HetGATNetwork):
    alone, workers = segment_collector(task(turns=12), "sync", 1), segment_collector(task(turns=12), "multi", 2)
    try:
        for _ in range(2):
            expected, found = alone.collect(policy, 8), workers.collect(policy, 8)
            for name in ("actions", "rewards", "times", "boundary"):
                assert torch.equal(getattr(expected, name), getattr(found, name)), name
    finally:
        workers.close()


@pytest.mark.slow
def test_ray_workers_play_as_one_process_does(policy: HetGATNetwork):
    pytest.importorskip("ray", reason="the extra `cluster` is not installed")
    alone, workers = segment_collector(task(turns=12), "sync", 1), segment_collector(task(turns=12), "ray", 2)
    try:
        expected, found = alone.collect(policy, 8), workers.collect(policy, 8)
        for name in ("actions", "rewards", "times", "boundary"):
            assert torch.equal(getattr(expected, name), getattr(found, name)), name
    finally:
        workers.close()


def test_a_resumed_run_with_workers_plays_no_episode_twice():
    collector = WorkerCollector(task(turns=5), 2)
    collector._updates = 3
    other = WorkerCollector(task(turns=5), 2)
    other.restore(collector.state())
    env = other._factories()[1]()
    env.reset()
    source = source_of(["small"], seed=3, rows=4)
    assert env.simulator.instances[0].identity == source(2, 15).identity


def test_workers_share_rows_evenly():
    with pytest.raises(InvalidOptionError, match=r"workers: expected a divisor of the 4 rows.*got 3"):
        segment_collector(task(), "multi", 3)


def test_instances_of_a_run_are_those_of_no_evaluation_with_the_same_seed():
    domain = get_domain("airme")
    source = source_of(["small"], seed=3, rows=8)
    drawn = {source(row, count).identity for row in range(8) for count in range(3)}
    assert len(drawn) == 24
    assert not drawn & {instance.identity for instance in domain.instances("small", 30, 3)}


def test_scales_take_turns():
    source = source_of(["small", "large"], seed=0, rows=4)
    sizes = [source(row, 0).n_planes for row in range(4)]
    assert [size > 40 for size in sizes] == [False, True, False, True]


def test_rows_play_the_same_in_whatever_part_of_the_run_they_are(policy: HetGATNetwork):
    whole, part = task(turns=None).environment(), task(turns=None).environment(2, 2)
    whole.reset(), part.reset()
    identities = [instance.identity for instance in whole.simulator.instances]
    assert identities[2:] == [instance.identity for instance in part.simulator.instances]
    assert np.array_equal(whole.simulator.episode_keys[2:], part.simulator.episode_keys)

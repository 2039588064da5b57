from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import LocalView
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.train.collect import EpisodeCollector, InstanceSource, Rollout, SegmentCollector


def environment(rows: int = 4, episodes: int = 1, horizon: int = 100) -> SchedulingTorchRL:
    source = InstanceSource(get_domain("airme"), ["small"], seed=3, rows=rows, episodes=episodes)
    return SchedulingTorchRL("airme", batch_size=rows, source=source, view=LocalView(), horizon=horizon, seed=3)


def pick(observation: dict[str, torch.Tensor], uniform: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Any legal action, all alike."""
    legal = observation["action_mask"].numpy() > 0
    rank = np.floor(uniform * legal.sum(axis=1))
    actions = (legal.cumsum(axis=1) > rank[:, None]).argmax(axis=1)
    return torch.from_numpy(actions), torch.from_numpy(-np.log(legal.sum(axis=1)).astype(np.float32))


def same(a: Rollout, b: Rollout) -> bool:
    columns = ("actions", "log_probs", "rewards", "elapsed", "times", "valid", "alive")
    views = (("observation", name) for name in a.observation)
    centrals = (("central", name) for name in a.central)
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in columns) and all(
        torch.equal(getattr(a, view)[name], getattr(b, view)[name]) for view, name in (*views, *centrals)
    )


def test_whole_episodes_are_cut_at_the_length_in_every_row():
    rollout = EpisodeCollector(environment(), central=False).collect(pick, 20)
    valid = rollout.valid
    assert not valid[-1].any()
    assert (rollout.times[valid] < 20).all()
    assert len(set(valid.sum(0).tolist())) > 1, "rows end at different decision counts"
    assert (valid[1:] <= valid[:-1]).all(), "a row does not come back"


def test_rows_that_share_an_instance_stand_side_by_side_and_differ_in_noise():
    collector = EpisodeCollector(environment(rows=6, episodes=3), central=False)
    rollout = collector.collect(pick, 20)
    identities = [instance.identity for instance in collector.env.simulator.instances]
    assert identities[0] == identities[1] == identities[2] != identities[3] == identities[4] == identities[5]
    assert not torch.equal(rollout.rewards[:, 0], rollout.rewards[:, 1])
    collector.collect(pick, 20)
    assert collector.env.simulator.instances[0].identity not in identities


def test_a_segment_goes_on_where_the_last_one_stopped():
    collector = SegmentCollector(environment(), turns=16, length=1000, central=True)
    collector._cut[:] = 1000
    first, second = collector.collect(pick, 1000), collector.collect(pick, 1000)
    assert torch.equal(first.times[-1], second.times[0])
    assert torch.equal(first.observation["plane"][-1], second.observation["plane"][0])
    assert first.valid.all()


def test_a_row_at_its_length_is_observed_once_more_and_begins_a_new_instance():
    collector = SegmentCollector(environment(), turns=60, length=8, central=True)
    before = [instance.identity for instance in collector.env.simulator.instances]
    rollout = collector.collect(pick, 8)
    for row in range(4):
        cuts = (~rollout.valid[:, row]).nonzero().squeeze(1)
        assert len(cuts) > 1
        for cut in cuts[:-1].tolist():
            assert rollout.alive[cut, row]
            assert rollout.times[cut, row] >= (8 if cut > cuts[0] else 1)
            assert rollout.times[cut + 1, row] == 0
    assert not set(before) & {instance.identity for instance in collector.env.simulator.instances}


def test_an_end_of_the_environment_is_no_future():
    collector = SegmentCollector(environment(horizon=5), turns=40, length=50, central=False)
    rollout = collector.collect(pick, 50)
    ended = ~rollout.alive
    assert ended.any()
    assert (rollout.times[ended] == 5).all()
    assert not (rollout.valid & ended).any()


@pytest.mark.parametrize(
    "make",
    [
        lambda: SegmentCollector(environment(), turns=24, length=12, central=True),
        lambda: EpisodeCollector(environment(rows=4, episodes=2), central=False),
    ],
)
def test_a_restored_collector_goes_on_exactly(make: Callable[[], SegmentCollector | EpisodeCollector]):
    collector, other = make(), make()
    for _ in range(3):
        collector.collect(pick, 12)
    other.restore(collector.state())
    assert same(collector.collect(pick, 12), other.collect(pick, 12))


def test_instances_of_a_run_are_those_of_no_evaluation_with_the_same_seed():
    domain = get_domain("airme")
    source = InstanceSource(domain, ["small"], seed=3, rows=8)
    drawn = {source(row, count).identity for row in range(8) for count in range(3)}
    assert len(drawn) == 24
    assert not drawn & {instance.identity for instance in domain.instances("small", 30, 3)}


def test_scales_take_turns():
    source = InstanceSource(get_domain("airme"), ["small", "large"], seed=0, rows=4)
    sizes = [source(row, 0).n_planes for row in range(4)]
    assert [size > 40 for size in sizes] == [False, True, False, True]

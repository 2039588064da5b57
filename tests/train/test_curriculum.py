from __future__ import annotations

import pytest

from marl_sched.errors import InvalidOptionError
from marl_sched.train.curriculum import EpisodeLength

PUBLISHED = EpisodeLength(start=50, step=0.8, stop=200, spread=30, seed=3)


def test_episodes_grow_from_t_min_to_t_max():
    shortest = [min(50 + 0.8 * update, 200) for update in (0, 100, 187, 188, 2000)]
    lengths = [PUBLISHED(update) for update in (0, 100, 187, 188, 2000)]
    assert all(int(low) <= length <= int(low) + 30 for low, length in zip(shortest, lengths, strict=True))
    assert PUBLISHED.longest == 230


def test_length_is_a_function_of_seed_and_update():
    assert [PUBLISHED(update) for update in range(50)] == [PUBLISHED(update) for update in range(50)]
    assert len({PUBLISHED(2000 + update) for update in range(100)}) > 10


def test_a_curriculum_that_shrinks_is_refused():
    with pytest.raises(InvalidOptionError, match="stop: expected at least start"):
        EpisodeLength(start=100, step=1.0, stop=50, spread=0, seed=0)

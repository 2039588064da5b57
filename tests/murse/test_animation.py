"""The moving picture of a round: who stands where is worked out by hand."""

from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

from marl_sched.cli import demo  # noqa: E402
from marl_sched.domain import get_domain  # noqa: E402
from marl_sched.envs.murse import animation  # noqa: E402
from marl_sched.errors import InvalidOptionError  # noqa: E402
from marl_sched.train.evaluation.animation import save_animation  # noqa: E402
from marl_sched.train.evaluation.compare import play_episode  # noqa: E402

ROUND = {
    "agents": ["robot 0", "human 1"],
    "robots": 1,
    "tasks": [{"location": [0.0, 0.0], "deadline": 3}, {"location": [4.0, 2.0], "deadline": None}],
    "dispatch": [
        {"task": 2, "agent": 0, "start": 10, "finish": 12},
        {"task": 1, "agent": 0, "start": 2, "finish": 6},
    ],
}


@pytest.mark.parametrize(
    ("time", "expected"),
    [(0, (0, 0)), (4, (0, 0)), (6, (0, 0)), (7, (1, 0.5)), (8, (2, 1)), (10, (4, 2)), (99, (4, 2))],
)
def test_an_agent_walks_straight_from_the_end_of_a_task_to_the_start_of_its_next(time, expected):
    places, span = animation._places(ROUND)
    assert span == 4.0
    assert animation._position(ROUND, places, 0, time) == pytest.approx(expected)


def test_a_task_is_white_before_its_agents_colour_during_and_grey_after_it_with_a_red_rim_if_late():
    colours = [animation._colour(ROUND, 0, time) for time in (1, 2, 5, 6)]
    assert colours == [animation._OPEN, animation.ROBOT, animation.ROBOT, animation.WAIT]
    assert [animation._rim(ROUND, 0, time) for time in (5, 6)] == [animation._INK, animation.LATE]
    assert animation._rim(ROUND, 1, 99) == animation._INK


def test_tasks_of_one_place_are_drawn_side_by_side():
    places, _ = animation._places({"tasks": [{"location": [1, 1]}, {"location": [1, 1]}, {"location": [9, 1]}]})
    assert places[1, 0] - places[0, 0] == pytest.approx(8 * animation._APART)
    assert places[:2, 0].mean() == 1
    assert places[2].tolist() == [9, 1]


def test_the_demonstrations_episode_becomes_a_gif_of_all_frames(tmp_path):
    domain = get_domain("murse")
    problem = demo.deployed_problem(domain, "lst-local").but(horizon=1)
    assert problem.options == {"mode": "online", "durations": "stochastic"}
    played = play_episode(problem, demo.create_schedulers(domain, ["lst-local"])["lst-local"])
    frames = list(animation.round_frames(played, count=5))
    assert [frame.shape for frame in frames] == [(600, 900, 3)] * 5
    assert all(np.any(one != other) for one, other in pairwise(frames))
    save_animation(tmp_path / "round.gif", frames)
    with Image.open(tmp_path / "round.gif") as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (5, (900, 600), 0)
    with pytest.raises(InvalidOptionError, match="at least one frame"):
        save_animation(tmp_path / "none.gif", [])

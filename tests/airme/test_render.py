"""The fleet board and the timeline show what is so."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.envs.airme.render import COLOURS, fleet_board, timeline
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.timeline_figure import episode_figure, jobs
from marl_sched.errors import InvalidOptionError
from tests.airme.fleets import RESERVE, STEADY, fleet, plane, play

FLEET = fleet(
    (STEADY, 10.0, 31, 7, False),
    (RESERVE, 8.0, 2, 0, True),
    (RESERVE, 4.0, 30, 12, True),
    (RESERVE, 4.0, 5, 1, False),
    n_crews=2,
)


@pytest.fixture
def simulator() -> AirmeSimulator:
    simulator = AirmeSimulator([FLEET], record_timeline=True)
    play(simulator, [3, 0], [0, 0])
    return simulator


def test_board_tells_of_every_plane_and_crew(simulator: AirmeSimulator) -> None:
    board = fleet_board(simulator)
    flying, repair = plane(simulator, 1), plane(simulator, 3)
    cells = [" ".join(cell.split()) for line in board.splitlines()[1:] for cell in line.split("   ") if cell.strip()]
    text = " ".join(board.split())
    assert "hour 2 profit" in text
    assert f"1 steady 33 h 7 ldg flying 2/{flying['mission_hours']}" in text
    assert "2 reserve 2 h 0 ldg BROKEN" in text
    assert f"3 reserve 30 h 12 ldg repair 2/{repair['job_hours']} by crew 0" in text
    assert "4 reserve 5 h 1 ldg grounded" in text
    assert "crew 0: plane 3" in text
    assert "crew 1: free" in text
    assert cells[-1] == "crew 1: free"


def test_board_shows_the_means_so_far(simulator: AirmeSimulator) -> None:
    # Plane 1 alone earns, 10 of 26; two of four planes are available.
    head = fleet_board(simulator).splitlines()[0]
    assert f"revenue {10 / 26:.3f}" in head
    assert "availability 0.500" in head


def test_frames_are_alike_and_show_every_status_by_its_colour(simulator: AirmeSimulator) -> None:
    first = timeline(simulator)
    assert (first.shape, first.dtype) == ((540, 960, 3), np.uint8)
    simulator.step(np.zeros(1, np.int64))
    assert timeline(simulator).shape == first.shape
    for colour in COLOURS.values():  # each also stands in the legend, so it is there more often than there
        assert (first == colour).all(axis=2).sum() > 100


def test_crews_jobs_are_told_from_the_planes_they_served() -> None:
    assert jobs(np.array([3, 3, 0, 2, 4, 4])) == [(0, 2, 3), (3, 4, 2), (4, 6, 4)]
    assert jobs(np.array([0, 0])) == []


def test_who_served_which_plane_is_on_record(simulator: AirmeSimulator) -> None:
    assert simulator.state.jobs[0, :2].tolist() == [[3, 0], [3, 0]]


def test_episodes_share_their_axis_and_crews_have_rows(simulator: AirmeSimulator) -> None:
    longer = AirmeSimulator([FLEET], record_timeline=True)
    play(longer, [3, 0], [0, 0], [0, 0])
    figure = episode_figure({"two hours": simulator, "three hours": longer})
    assert {axes.get_xlim() for axes in figure.axes} == {(0.0, 3.0)}
    crews = figure.axes[1]
    assert [label.get_text() for label in crews.get_yticklabels()] == ["crew 0", "crew 1"]


def test_timeline_that_was_not_recorded_raises() -> None:
    with pytest.raises(InvalidOptionError, match="record_timeline=True"):
        timeline(AirmeSimulator([FLEET]))

"""The fleet board and the timeline show what is so."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.envs.airme.render import COLOURS, fleet_board, timeline
from marl_sched.envs.airme.simulator import AirmeSimulator
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


def test_timeline_colours_what_each_plane_did(simulator: AirmeSimulator) -> None:
    image = timeline(simulator)
    assert image.dtype == np.uint8
    hours, planes = 2, 4
    height, width = image.shape[0] // planes, image.shape[1] // hours
    assert image.shape == (height * planes, width * hours, 3)
    grey, blue, red, amber = (COLOURS[k] for k in range(4))
    seen = [[tuple(image[p * height, h * width]) for h in range(hours)] for p in range(planes)]
    assert seen == [[blue] * 2, [red] * 2, [amber] * 2, [grey] * 2]


def test_timeline_that_was_not_recorded_raises() -> None:
    with pytest.raises(InvalidOptionError, match="record_timeline=True"):
        timeline(AirmeSimulator([FLEET]))

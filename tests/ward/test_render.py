"""Pictures of a ward."""

import numpy as np
import pytest

from marl_sched.envs.ward.render import CELL, FREE, WITH_CARE, WITHOUT_CARE, board, timeline
from marl_sched.errors import InvalidOptionError
from tests.ward.wards import play, quiet, waiting, ward


def test_the_board_says_who_waits_who_lies_where_and_what_nurses_do():
    simulator = quiet(ward(waiting("active", high_risk=True), waiting("early", section=1), beds=(0, 1)))
    play(simulator, 1)
    head, *sections, nurses = board(simulator).splitlines()
    assert head.split()[0] == "0:30"
    assert sections == [
        "section 0   beds: 1 active! (nurse 0)   waiting: nobody",
        "section 1   beds: free   waiting: 2 early",
    ]
    assert nurses == "nurse 0 (section 0): load 2"


def test_the_timeline_shows_each_bed_and_whether_there_was_care_in_pictures_of_one_size():
    """Bed 0 holds a patient in active labour, two quarters with care; in the next two her nurse admits another."""
    simulator = quiet(ward(waiting("active"), waiting("early"), beds=(0, 0)), record_timeline=True)
    before = timeline(simulator)
    play(simulator, 1, 2)
    image = timeline(simulator)
    assert image.shape == before.shape == (2 * CELL, 16, 3)
    assert (before == 255).all()
    assert image[0, ::4].tolist() == [list(WITH_CARE[1])] * 2 + [list(WITHOUT_CARE)] * 2
    assert image[CELL, ::4].tolist() == [list(FREE)] * 2 + [list(WITH_CARE[0])] * 2
    assert image.dtype == np.uint8


def test_a_picture_without_a_record_is_refused():
    with pytest.raises(InvalidOptionError, match="record_timeline=True"):
        timeline(quiet(ward(waiting("active"))))

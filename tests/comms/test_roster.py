"""The world counts on one incarnation per agent, and never again on one that it gave up."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from marl_sched.comms.roster import Roster


def test_everybody_is_missing_until_admitted():
    roster = Roster(3, patience=2)
    assert roster.admit(1, "a", "condition") == ""
    assert roster.missing() == [0, 2]


def test_second_process_for_the_same_agent_is_refused_while_the_first_lives():
    roster = Roster(1, patience=2)
    roster.admit(0, "a", "condition")
    assert "another process" in roster.admit(0, "b", "condition")
    assert roster.seats[0].incarnation == "a"


def test_agent_that_does_not_exist_is_refused():
    assert "there is no agent 7, the run has agents 0 to 6" in Roster(7, patience=2).admit(7, "a", "condition")


def test_buried_incarnation_is_refused_and_its_successor_admitted():
    roster = Roster(1, patience=2)
    roster.admit(0, "a", "condition")
    assert roster.bury(0, "a")
    assert "declared dead" in roster.admit(0, "a", "condition")
    assert roster.admit(0, "b", "random") == ""
    assert roster.seats[0].policy == "random"


def test_burying_an_incarnation_that_is_not_counted_on_changes_nothing():
    roster = Roster(1, patience=2)
    roster.admit(0, "b", "condition")
    assert not roster.bury(0, "a")
    assert not roster.bury(0, "")
    assert roster.seats[0].incarnation == "b"


def test_patience_ends_after_misses_in_a_row_only():
    roster = Roster(1, patience=2)
    roster.admit(0, "a", "condition")
    assert not roster.miss(0, 0.5)
    roster.answered(0)
    assert not roster.miss(0, 0.5)
    assert roster.miss(0, 0.25)
    assert roster.seats[0].waited == 0.75


def test_hello_that_is_repeated_does_not_renew_patience():
    roster = Roster(1, patience=2)
    roster.admit(0, "a", "condition")
    roster.miss(0, 0.5)
    assert roster.admit(0, "a", "condition") == ""
    assert roster.miss(0, 0.5)


def test_successor_of_a_silent_incarnation_is_given_up_at_its_first_miss():
    roster = Roster(1, patience=2)
    roster.admit(0, "a", "condition")
    roster.miss(0, 0.5)
    assert roster.miss(0, 0.5)
    roster.bury(0, "a")
    assert roster.admit(0, "b", "condition") == ""
    assert roster.miss(0, 0.5)
    assert roster.seats[0].waited == 1.5


def test_decision_in_time_gives_a_successor_all_patience_again():
    roster = Roster(1, patience=2)
    roster.seats[0].missed = 3
    roster.admit(0, "b", "condition")
    roster.answered(0)
    assert not roster.miss(0, 0.5)


@given(patience=st.integers(1, 4), fates=st.lists(st.sampled_from(["late", "gone", "answers", "hello"]), max_size=60))
def test_nobody_is_waited_for_in_vain_more_than_twice_patience_times_between_two_decisions(patience, fates):
    roster, incarnations, in_vain = Roster(1, patience), 0, 0
    seat = roster.seats[0]
    for fate in fates:
        if not seat.incarnation:
            incarnations += 1
            refused = roster.admit(0, str(incarnations), "condition")
            assert bool(refused) == (in_vain == 2 * patience)
        elif fate == "answers":
            roster.answered(0)
            in_vain = 0
        elif fate in ("late", "gone"):
            in_vain += 1
            if roster.miss(0, 1.0) or fate == "gone":
                roster.bury(0, seat.incarnation)
        assert seat.waited == in_vain <= 2 * patience

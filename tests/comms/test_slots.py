"""Every state and transition of a slot, and the bound on what is waited for one agent."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_sched.comms.membership.slots import TRANSITIONS, Membership, Slot, SlotEvent, SlotState


def test_every_state_can_be_reached_and_left():
    reached = {SlotState.VACANT}
    while more := {to for (state, _), to in TRANSITIONS.items() if state in reached} - reached:
        reached |= more
    assert reached == set(SlotState)
    assert {state for state, _ in TRANSITIONS} == set(SlotState)


def test_every_event_is_used():
    assert {event for _, event in TRANSITIONS} == set(SlotEvent)


def test_transition_that_is_not_in_the_table_is_a_defect():
    with pytest.raises(KeyError):
        Slot().move(SlotEvent.DECIDE)


def joined(n: int = 1, patience: int = 2) -> Membership:
    members = Membership(n, patience, bar=60.0)
    for agent in range(n):
        members.slots[agent].tokens.append("a")
        members.register(agent, "a", "p", 0.0)
    return members


def test_everybody_is_absent_until_registered():
    members = Membership(3, 2, 60.0)
    members.register(1, "a", "p", 0.0)
    assert members.absent() == [0, 2]


def test_second_process_for_the_same_agent_is_refused_while_the_first_is_heard():
    members = joined()
    members.slots[0].tokens.append("b")
    assert members.refusal(0, "b") == "taken"
    members.cut(0, until=5.0)
    assert members.refusal(0, "b") is None


def test_given_up_incarnation_is_refused_and_its_successor_is_not():
    members = joined()
    members.cut(0, until=5.0)
    members.give_up(0, 5.0)
    members.slots[0].tokens.append("b")
    assert members.refusal(0, "a") == "given_up"
    assert members.refusal(0, "b") is None


@pytest.mark.parametrize(
    ("present", "left", "quorum", "quorate"),
    [
        (2, 0, 0.5, True),
        (1, 0, 0.5, False),
        (1, 0, 0.25, True),
        (0, 0, 0.0, False),
        (1, 2, 0.5, True),
        (0, 4, 1.0, True),
    ],
)
def test_quorum_is_a_share_of_those_that_have_not_left_and_one_at_least(present, left, quorum, quorate):
    members = joined(4)
    for agent in range(present, 4 - left):
        members.cut(agent, until=5.0)
    for agent in range(4 - left, 4):
        members.leave(agent)
    assert members.quorate(quorum) == quorate


@given(patience=st.integers(1, 4), fates=st.lists(st.sampled_from(["late", "gone", "answers"]), max_size=60))
def test_nobody_is_waited_for_in_vain_more_than_twice_patience_times_before_it_is_barred(patience, fates):
    members, incarnations, in_vain = Membership(1, patience, 60.0), 0, 0
    slot = members.slots[0]
    for fate in fates:
        if not slot.present:
            incarnations += 1
            slot.tokens.append(str(incarnations))
            refusal = members.refusal(0, str(incarnations))
            assert (refusal == "barred") == (in_vain == 2 * patience)
            if refusal is None:
                members.register(0, str(incarnations), "p", 0.0)
            continue
        slot.move(SlotEvent.ASK)
        if fate == "answers":
            members.answered(0)
            in_vain = 0
            continue
        in_vain += 1
        too_often = members.miss(0, 1.0)
        if fate == "gone":
            members.cut(0, until=1.0)
        elif not too_often:
            slot.move(SlotEvent.MISS)
        if fate == "gone" or too_often:
            members.give_up(0, 1.0)
        assert slot.waited == in_vain <= 2 * patience

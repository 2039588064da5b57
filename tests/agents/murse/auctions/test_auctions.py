"""Auctions over explicit messages: no conflicting claims with full communication, conflicts without, all counted."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.agents.murse.auctions.agent_schedule import UNKNOWN, AgentSchedule
from marl_sched.agents.murse.auctions.cbba import CbbaBidder, put_in_order, waves
from marl_sched.agents.murse.auctions.consensus import LEAVE, RESET, UPDATE, resolve
from marl_sched.agents.murse.auctions.messages import Consensus, Offer, decode, encode
from marl_sched.agents.murse.auctions.network import Bidder, Talk, hearing, negotiate
from marl_sched.agents.murse.auctions.tessi import TessiBidder
from marl_sched.agents.murse.negotiated import Cbba, Tessi
from marl_sched.agents.murse.problem import Round
from marl_sched.domain import get_domain
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.views import LocalView
from marl_sched.errors import InvalidMessageError
from tests.agents.murse.playing import finished
from tests.murse.problems import instances, problem


def by_index(schedule: AgentSchedule, n_agents: int) -> TessiBidder:
    """A bidder to whom later tasks are more urgent."""
    return TessiBidder(schedule, -np.arange(len(schedule.holder)))


SIDES = {
    "tessi": lambda schedule, n: TessiBidder(schedule, np.zeros(len(schedule.holder), np.int64)),
    "urgent": by_index,
    "cbba": CbbaBidder,
}
sides = pytest.mark.parametrize("side", SIDES)


def schedules_of(instance: MurseInstance) -> list[AgentSchedule]:
    whole = Round.of(instance)
    return [AgentSchedule(a, whole.durations, whole.lags, whole.near, whole.deadlines) for a in range(whole.n_agents)]


def negotiated(instance: MurseInstance, side: str, hears: np.ndarray | None = None) -> tuple[list[AgentSchedule], Talk]:
    schedules = schedules_of(instance)
    bidders: list[Bidder] = [SIDES[side](schedule, len(schedules)) for schedule in schedules]
    everybody = np.ones((len(schedules), len(schedules)), bool)
    talk = negotiate(bidders, everybody if hears is None else hears, 10_000)
    assert all(bidder.finished for bidder in bidders)
    return schedules, talk


@sides
@settings(max_examples=80, deadline=None)
@given(instance=instances())
def test_who_all_hear_each_other_end_with_one_holder_per_task_and_the_same_beliefs(side, instance):
    schedules, _ = negotiated(instance, side)
    claimed = sorted(task for schedule in schedules for task in schedule.path)
    assert claimed == list(range(instance.n_tasks))
    for schedule in schedules:
        assert all(instance.eligible[task, schedule.agent] for task in schedule.path)
        assert np.array_equal(schedule.holder, schedules[0].holder)
        assert np.array_equal(schedule.starts, schedules[0].starts)


@sides
@settings(max_examples=40, deadline=None)
@given(instance=instances())
def test_what_everybody_believes_can_be_done(side, instance):
    schedules, _ = negotiated(instance, side)
    starts, finishes, holder = schedules[0].starts, schedules[0].finishes, schedules[0].holder
    for i in range(instance.n_tasks):
        for j in np.flatnonzero(instance.lags[i] >= 0):
            assert starts[i] >= finishes[j] + instance.lags[i, j]
        for j in range(i):
            if instance.near[i, j] or holder[i] == holder[j]:
                assert starts[i] >= finishes[j] or starts[j] >= finishes[i]


@sides
@settings(max_examples=40, deadline=None)
@given(instance=instances(), radius=st.sampled_from([0.0, 2.5]))
def test_negotiations_end_whoever_hears_whom(side, instance, radius):
    schedules, talk = negotiated(instance, side, hearing(instance.n_agents, 5.0, radius))
    claimed = {task for schedule in schedules for task in schedule.path}
    assert len(claimed) == instance.n_tasks or instance.n_agents > 1
    assert talk.messages > 0


@sides
def test_agents_that_hear_nobody_all_claim_everything(side):
    instance = problem([[3, 4], [2, 2]])
    schedules, _ = negotiated(instance, side, np.eye(2, dtype=bool))
    assert [sorted(schedule.path) for schedule in schedules] == [[0, 1], [0, 1]]


def test_each_single_item_goes_to_the_agent_that_would_end_its_work_first():
    # turn 1: robot 1 would end at 2 with task 2, robot 2 at 3 with it: robot 1 wins; turn 2: 2 + 4 against 5
    schedules, talk = negotiated(problem([[4, 5], [2, 3]]), "tessi")
    assert [schedule.path for schedule in schedules] == [[1], [0]]
    assert (talk.turns, talk.messages) == (3, 6)  # in the third turn nobody bids


def test_the_most_urgent_task_is_auctioned_first_and_goes_to_who_would_end_first():
    # to these bidders task 2 is the more urgent: robot 2 would end it at 3 and wins, then task 1 goes to robot 1 at 4
    schedules, _ = negotiated(problem([[4, 5], [7, 3]]), "urgent")
    assert [schedule.path for schedule in schedules] == [[0], [1]]
    # by the end of work alone robot 2 wins task 2 first as well, but with 6 instead of 3 task 1 comes first
    for side, first in (("urgent", 1), ("tessi", 0)):
        schedule = schedules_of(problem([[4], [6]]))[0]
        assert decode(SIDES[side](schedule, 1).speak()).task == first


def test_a_settled_wave_is_put_in_the_order_of_the_least_lateness():
    # Near tasks of two agents: task 1 is promised from 0 to 5, task 2 from 1 to 4 and due at 4. In the order of
    # promised starts task 2 would end at 5 + 3 = 8, 4 too late; by promised finish it goes first and nothing is late.
    schedule = schedules_of(problem([[5, 0], [0, 3]], locations=[[1, 1], [1, 1]], deadlines=[-1, 4]))[0]
    schedule.note(0, [(0, 0, 5)])
    schedule.note(1, [(1, 1, 4)])
    put_in_order(schedule, 2, schedule.deadlines)
    assert (schedule.starts.tolist(), schedule.finishes.tolist()) == ([3, 0], [8, 3])


def test_a_task_is_inserted_where_its_deadline_demands():
    # task 1 lasts 4 and is won first for want of a rival; task 2 is due at 9 but task 3, of 6 units, is due at 6
    schedules, _ = negotiated(problem([[4], [9], [6]], deadlines=[-1, -1, 6]), "tessi")
    assert schedules[0].path[0] == 2
    assert schedules[0].finishes[2] == 6


def test_a_task_that_fits_nobody_is_still_taken():
    for side in SIDES:
        schedules, _ = negotiated(problem([[4, 6], [4, 6]], deadlines=[2, 2]), side)
        assert sorted(schedules[0].path + schedules[1].path) == [0, 1]


def test_tasks_come_in_waves_by_what_they_wait_for():
    lags = np.full((4, 4), -1)
    lags[1, 0] = lags[2, 1] = lags[2, 3] = 0
    assert waves(lags) == [[0, 3], [1], [2]]


def test_bundles_lose_what_was_added_after_a_lost_task():
    schedule = schedules_of(problem([[2, 1], [3, 30], [4, 40]]))[0]
    bidder = CbbaBidder(schedule, 2)
    mine = decode(bidder.speak())
    assert mine.winners == [0, 0, 0]
    higher = [bid + 1.0 if task == 0 else -1e18 for task, bid in enumerate(mine.bids)]
    bidder.hear(encode(Consensus(1, 0, [1, -1, -1], higher, [0, -1, -1], [1, -1, -1], [-1, 0], 0)))
    bidder.conclude()
    assert decode(bidder.speak()).winners == [1, 0, 0]


@pytest.mark.parametrize(
    ("mine", "theirs", "my_bid", "their_bid", "fresh", "action"),
    [
        (0, 1, 5.0, 6.0, (), UPDATE),  # the sender outbids me
        (0, 1, 6.0, 6.0, (), LEAVE),  # a tie stays with the lower agent
        (1, 1, 6.0, 5.0, (), UPDATE),  # the sender knows its own bid best
        (2, 1, 6.0, 5.0, (2,), UPDATE),  # the sender has later news of the third
        (2, 1, 6.0, 5.0, (), LEAVE),
        (1, 0, 6.0, 5.0, (), RESET),  # each believes the other to have it
        (2, 0, 6.0, 5.0, (2,), RESET),
        (-1, 0, 6.0, 5.0, (), LEAVE),
        (0, 2, 5.0, 6.0, (2,), UPDATE),
        (0, 2, 5.0, 6.0, (), LEAVE),
        (1, 2, 5.0, 6.0, (), RESET),
        (3, 2, 6.0, 5.0, (2, 3), UPDATE),
        (3, 2, 5.0, 6.0, (2,), UPDATE),
        (3, 2, 5.0, 6.0, (3,), RESET),
        (3, 2, 6.0, 5.0, (2,), LEAVE),
        (1, -1, 5.0, 0.0, (), UPDATE),
        (2, -1, 5.0, 0.0, (2,), UPDATE),
        (2, -1, 5.0, 0.0, (), LEAVE),
        (0, -1, 5.0, 0.0, (), LEAVE),
    ],
)
def test_beliefs_are_settled_by_the_table_of_the_paper(mine, theirs, my_bid, their_bid, fresh, action):
    news = np.zeros(4, np.int64)
    later = news.copy()
    later[list(fresh)] = 1
    assert resolve(0, 1, mine, theirs, my_bid, their_bid, news, later) == action


def test_messages_come_back_as_they_were_sent_and_others_are_refused():
    offer = Offer(1, 4, 2, False, 0, 30, [(2, 10, 30)])
    assert decode(encode(offer)) == offer
    for payload in (b"", b"\xc1", msgspec.msgpack.encode(["claim", 1]), encode(offer)[:-1]):
        with pytest.raises(InvalidMessageError):
            decode(payload)
    schedule = schedules_of(problem([[1]]))[0]
    with pytest.raises(InvalidMessageError, match="expected a consensus message"):
        CbbaBidder(schedule, 1).hear(encode(offer))


def test_stations_stand_in_a_row_along_the_map():
    assert hearing(3, 4.0, 2.0).tolist() == [[True, True, False], [True, True, True], [False, True, True]]
    assert hearing(3, 4.0, float("inf")).all()


@pytest.mark.parametrize("kind", [Tessi, Cbba])
def test_deaf_agents_run_into_conflicts_that_the_simulator_counts_and_that_cost_time(kind):
    problems = get_domain("murse").instances("small", 4, 7)
    hearing_all, deaf = kind(), kind(radius=0.0)
    well, badly = (finished(each, problems, horizon=2).objectives() for each in (hearing_all, deaf))
    assert well["conflicts"].sum() == 0
    assert badly["conflicts"].sum() > 0
    assert badly["makespan"].mean() > well["makespan"].mean()
    assert UNKNOWN < 0 < deaf.per_round()["messages"][:, :2].min()


def test_without_a_radius_of_their_own_agents_hear_as_far_as_the_view_lets_them():
    problems = get_domain("murse").instances("small", 4, 7)
    seen = [
        finished(scheduler, problems, horizon=1, view=view).objectives()["conflicts"].sum()
        for scheduler, view in ((Tessi(), LocalView(comm=0.0)), (Tessi(radius=0.0), None), (Tessi(), None))
    ]
    assert seen[0] == seen[1] > seen[2] == 0

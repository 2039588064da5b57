"""The couriers' domain holds to the contract: work arrives and is cancelled, an agent is away."""

import numpy as np
import pytest

from marl_sched.testing import check_domain, check_scheduler, check_view


def test_the_domain_and_its_scheduler_hold_to_the_contract(installed):
    from couriers.schedulers import Itinerary, OldestFirst

    check_domain("couriers-deployable", instances=2)
    check_scheduler("couriers", OldestFirst)
    check_scheduler("couriers", Itinerary)


def far(reach):
    """Scrambles the work of jobs that are farther than `reach` from the agent's home."""

    def scramble(simulator, agent, rng):
        home = simulator.couriers["home"][0, agent]
        away = simulator.jobs["there"][0] & (np.abs(simulator.jobs["place"][0] - home) > reach)
        simulator.jobs["work"][0, away] = rng.integers(100, 1000, away.sum())

    return scramble


def every_job(simulator, agent, rng):
    simulator.jobs["work"][0] += 1


def test_the_near_view_hides_what_is_far(installed):
    from marl_sched.problem import Problem

    problem = Problem("couriers", count=5, view={"kind": "near", "reach": 3})
    check_view(problem, far(3), every_job)


@pytest.fixture
def simulator(installed):
    """Two jobs and two couriers.

    Job 1 is there from day 0 and takes one day. Job 2 arrives on day 1 and is cancelled on day 3 if it still waits.
    Courier 1 is away on days 0 to 1.
    """
    from couriers.instance import Courier, CouriersInstance, Job
    from couriers.simulator import CouriersSimulator

    jobs = (Job(0, 1, 2), Job(1, 1, 2, cancelled=3))
    return CouriersSimulator([CouriersInstance(jobs, (Courier(0), Courier(4, (0, 1))))], horizon=6, delay=0.0)


def there(simulator):
    return simulator.presence["job"][0].tolist(), simulator.availability["courier"][0].tolist()


def test_an_agent_that_is_away_has_no_turn_and_keeps_its_node(simulator):
    """On days 0 and 1 courier 0 alone has a turn; on day 2 both have."""
    turns = []
    while simulator.time[0] < 3:
        turns.append((int(simulator.time[0]), int(simulator.acting[0])))
        observation = simulator.observe(simulator.acting)
        assert observation["courier_mask"][0].tolist() == [1, 1]
        simulator.step(np.array([0]))
    assert turns == [(0, 0), (1, 0), (2, 0), (2, 1)]


def test_work_arrives_and_is_cancelled_while_it_waits(simulator):
    """Nobody works: job 1 waits on days 0 to 5, job 2 on days 1 and 2: six and two days of waiting in six days."""
    seen = {}
    while not simulator.over[0]:
        seen[int(simulator.time[0])] = there(simulator)[0]
        simulator.step(np.array([0]))
    assert seen[0] == [True, True, False]
    assert seen[1] == seen[2] == [True, True, True]
    assert seen[3] == [True, True, False]
    assert simulator.objectives()["waiting"][0] == pytest.approx((6 + 2) / 6)
    assert (simulator.truncated[0], simulator.progress[0], simulator.length[0]) == (True, 6, 6)


def test_work_that_is_done_goes_and_the_episode_ends_with_the_last(simulator):
    """Courier 0 does job 1 on day 0 and job 2 on day 1; on day 2 nothing is left, and nothing has waited."""
    simulator.step(np.array([1]))
    assert (simulator.time[0], there(simulator)) == (1, ([True, False, True], [True, False]))
    simulator.step(np.array([2]))
    assert (bool(simulator.terminated[0]), int(simulator.time[0])) == (True, 2)
    assert simulator.objectives()["waiting"][0] == 0.0


def test_two_who_cannot_see_one_another_meet_at_a_job(installed):
    """Under a view without reach both choose job 1, which lies at both homes' distance; the second idles."""
    from couriers.domain import COURIERS
    from couriers.instance import Courier, CouriersInstance, Job

    instance = CouriersInstance((Job(0, 2, 1), Job(9, 1, 1)), (Courier(0), Courier(2)))
    simulator = COURIERS.simulator([instance], view=COURIERS.view("near", reach=1), delay=0.0)
    simulator.step(np.array([1]))
    assert simulator.legal()[0, 1] == 1
    simulator.step(np.array([1]))
    assert bool(simulator.conflict[0])

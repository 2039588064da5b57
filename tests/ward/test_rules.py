"""Whom rules take over, with numbers worked out by hand, and what is best in a ward that can be searched whole."""

import itertools

import numpy as np
import pytest

from marl_sched.agents.ward.rollout import MarginalCostRollout
from marl_sched.agents.ward.rules import MarginalCost, first_come, least_slack, most_urgent, slack
from marl_sched.envs.ward.features import PATIENT
from marl_sched.envs.ward.instance import Patient
from marl_sched.envs.ward.lookahead import expected_rates
from marl_sched.errors import InvalidOptionError
from tests.ward.wards import play, quiet, waiting, ward


def choice(rule, simulator):
    return int(rule.decide(simulator)[0])


def test_rules_rank_by_arrival_by_cost_and_by_the_time_left_until_birth():
    """Costs an hour: 2 x 0.5, 2 and 4. Slack: first birth 24 + 18, active 12, recovery none; less two quarters each."""
    early = waiting("early", first=True, high_risk=True)
    simulator = quiet(ward(early, waiting("active"), waiting("recovery"), beds=(0, 0, 0)))
    assert choice(first_come(), simulator) == 1
    assert choice(most_urgent(), simulator) == 3
    assert choice(least_slack(), simulator) == 2
    assert slack(simulator.observe(simulator.acting)["patient"])[0, 1:3].tolist() == [40, 10]


def test_simple_rules_take_nobody_who_does_not_fit_into_the_capacity():
    """With patient 1, in birth, a nurse's capacity is used."""
    simulator = quiet(ward(waiting("birth"), waiting("early"), beds=(0, 0)))
    play(simulator, 1)
    assert [choice(rule(), simulator) for rule in (first_come, most_urgent, least_slack)] == [0, 0, 0]


def test_expected_rates_follow_labour():
    """Of two quarters in active labour the second is birth with probability 1/12: (2 + 11/12 x 2 + 1/12 x 8) / 2."""
    assert expected_rates(1)[0, 0].tolist() == [0.5, 2, 8, 4]
    assert expected_rates(2)[0, 0, 1] == pytest.approx(2.25)
    assert expected_rates(2)[1, 1, 1] == pytest.approx((1 + 17 / 18 + 8 / 18) / 2)


def test_marginal_cost_weighs_who_is_taken_over_asavedt_who_is_left_alone():
    """Over four quarters, with the stages' cost of now as the horizon is one in which `quiet` keeps them.

    A nurse with nobody saves by an admission all that a patient costs: expected_rates(4) x 4 / 4.
    """
    simulator = quiet(ward(waiting("early"), waiting("active"), beds=(0, 0)))
    saved = MarginalCost(horizon=4).savings(simulator.observe(simulator.acting))[0]
    rates = expected_rates(4)
    assert saved == pytest.approx([0, rates[0, 0, 0], rates[0, 0, 1]])
    play(simulator, 2)
    # Admitting patient 1 now leaves patient 2 without care for two of four quarters.
    saved = MarginalCost(horizon=4).savings(simulator.observe(simulator.acting))[0]
    assert saved[1] == pytest.approx(rates[0, 0, 0] - rates[1, 0, 1] / 2)
    with pytest.raises(InvalidOptionError, match="marginal-cost: horizon: expected an integer in"):
        MarginalCost(horizon=0)


def test_search_over_all_choices_of_an_hour_finds_what_the_urgent_rules_find():
    """One bed. With patient 2 in birth admitted at once, patient 1 waits in early labour for an hour: 0.5.

    Admitting patient 1 blocks the bed: patient 2 waits, 8 an hour. That is what first come, first served does.
    """
    simulator = quiet(ward(waiting("early"), waiting("birth")))
    start = simulator.save_state()

    def cost(decide):
        simulator.load_state(start)
        while simulator.acting[0] >= 0:
            simulator.step(np.array([decide()]))
        return float(simulator.state.rows["cost"][0])

    plans = [cost(iter(plan).__next__) for plan in itertools.product(range(3), repeat=4)]
    assert min(plans) == pytest.approx(0.5)
    assert max(plans) == pytest.approx(8.5)
    costs = [cost(lambda rule=rule: choice(rule(), simulator)) for rule in (first_come, most_urgent, MarginalCost)]
    assert costs == pytest.approx([8.0, 0.5, 0.5])


def test_roll_outs_find_what_search_finds_and_leave_the_ward_as_it_is():
    """Patient 2, in birth, has to have the one bed; a choice that is not legal costs infinitely."""
    simulator = quiet(ward(waiting("early"), waiting("birth"), Patient(9, 0)))
    before = simulator.save_state()
    costs = MarginalCostRollout(quarters=4, samples=8).costs(simulator, simulator.legal())[0]
    assert costs[2] < min(costs[0], costs[1])
    assert costs[3] == np.inf
    assert min(costs[0], costs[1]) >= 2.0  # one quarter of an hour of birth without a bed
    for name, array in simulator.save_state().arrays.items():
        assert array.tobytes() == before.arrays[name].tobytes(), name


def test_an_observation_tells_the_place_of_a_takeover_in_the_order_of_savings():
    """Waiting in birth costs 8, active labour 2, early 0.5 an hour; doing nothing saves nothing and comes last."""
    simulator = quiet(ward(waiting("early"), waiting("birth"), waiting("active"), beds=(0, 0, 0)))
    patient = simulator.observe(simulator.acting)["patient"]
    assert PATIENT.read(patient, "rank")[0].tolist() == [3, 2, 0, 1]
    assert PATIENT.read(patient, "saving")[0] == pytest.approx(
        MarginalCost().savings({"patient": patient, "action_mask": simulator.legal()})[0]
    )

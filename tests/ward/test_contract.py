"""The ward holds to the contract of domains, its schedulers to that of schedulers, its view to hiding what it hides."""

import numpy as np
import pytest

from marl_sched.agents.ward.schedulers import RULES
from marl_sched.domain import get_domain
from marl_sched.envs.ward.telemetry import TELEMETRY
from marl_sched.errors import InvalidMessageError, InvalidOptionError
from marl_sched.problem import Problem
from marl_sched.testing import check_domain, check_scheduler, check_view
from tests.ward.wards import play, quiet, waiting, ward

WARD = get_domain("ward")


def test_the_domain_holds_to_the_contract():
    check_domain("ward", horizon=4, instances=1)


@pytest.mark.parametrize("name", RULES)
def test_a_rule_holds_to_the_contract(name):
    check_scheduler("ward", RULES[name], horizon=4)


def far(simulator, agent, reach):
    """Patients and beds out of a nurse's sight, and nurses out of hearing with comm 0."""
    state, home = simulator.state, simulator.state.nurses["home"][0, agent]
    patients = np.abs(state.patients["section"][0] - home) > reach
    beds = np.abs(state.beds["section"][0] - home) > reach
    return patients, beds, state.nurses["home"][0] != home


def scramble_far(simulator, agent, rng):
    patients, beds, nurses = far(simulator, agent, reach=0)
    state = simulator.state
    state.patients["stage"][0, patients] = rng.integers(0, 4, patients.sum())
    state.patients["attended"][0, patients] = rng.random(patients.sum()) < 0.5
    state.patients["bed"][0, patients] = rng.integers(-1, 3, patients.sum())
    state.beds["patient"][0, beds] = rng.integers(0, 9, beds.sum())
    state.nurses["load"][0, nurses] = rng.integers(0, 9, nurses.sum())
    state.nurses["busy"][0, nurses] = rng.integers(0, 9, nurses.sum())
    state.nurses["choice"][0, nurses] = np.flatnonzero(patients)[0] if patients.any() else -1


def scramble_near(simulator, agent, rng):
    patients, _, _ = far(simulator, agent, reach=0)
    seen = ~patients & simulator.state.patients["there"][0]
    simulator.state.patients["stage"][0, seen] = (simulator.state.patients["stage"][0, seen] + 1) % 4
    simulator.state.nurses["load"][0, agent] += 1


def test_the_local_view_hides_what_is_far():
    check_view(Problem("ward", count=5, view={"kind": "local", "reach": 0, "comm": 0}), scramble_far, scramble_near)


def test_who_is_out_of_hearing_may_choose_the_same_patient_and_the_second_meets_a_conflict():
    """Nurses 0 and 1 live in sections 0 and 2 and both see section 1."""
    instance = ward(waiting("active", section=1), beds=(0, 1, 2), nurses=(0, 2))
    simulator = quiet(instance, view=WARD.view("local", reach=1, comm=0))
    play(simulator, 1)
    assert simulator.legal()[0].tolist() == [1, 1]
    play(simulator, 1)
    assert simulator.conflict[0]
    assert simulator.state.patients["nurse"][0, 1] == 0
    heard = quiet(instance, view=WARD.view("local", reach=1, comm=2))
    play(heard, 1)
    assert heard.legal()[0].tolist() == [1, 0]


def test_the_share_that_is_seen_is_of_the_patients_who_are_there():
    instance = ward(waiting("early"), waiting("early", section=2), beds=(0, 2), nurses=(0, 2))
    local = quiet(instance, view=WARD.view("local", reach=1))
    assert local.observe(local.acting)["visible_share"] == 0.5
    assert quiet(instance).observe(np.array([0]))["visible_share"] == 1.0


@pytest.mark.parametrize("options", [{"reach": -1}, {"comm": -1}])
def test_a_negative_range_is_refused(options):
    with pytest.raises(InvalidOptionError, match=r"view local: (reach|comm): expected an integer in"):
        WARD.view("local", **options)


def test_a_nurse_subscribes_to_what_her_view_allows_and_refuses_the_rest():
    instance = ward(waiting("early"), beds=(0, 1, 2, 3), nurses=(0, 1, 1))
    simulator = quiet(instance, view=WARD.view("local", reach=1, comm=0))
    frame, said = TELEMETRY.frame(simulator), TELEMETRY.messages(simulator)
    known = TELEMETRY.local_state(frame, 1)
    assert known.channels == ("nurse/1/status", "nurse/2/status", "section/0", "section/1", "section/2")
    with pytest.raises(InvalidMessageError, match="section/3: not a channel that nurse 1 hears"):
        known.hear("section/3", said["section/3"])
    with pytest.raises(InvalidMessageError, match=r"not a message of type ward\.section\.1"):
        known.hear("section/0", said["nurse/1/status"])
    with pytest.raises(InvalidMessageError, match="section 0: expected 1 beds with patients that there are"):
        known.hear("section/0", said["section/0"].replace(b"\xa4beds\x91\x00", b"\xa4beds\x91\x07"))
    with pytest.raises(InvalidMessageError, match="nurse 3 does not exist: there are 3"):
        TELEMETRY.local_state(frame, 3)


def test_who_will_arrive_is_told_to_nobody():
    """Two wards that differ in who comes later say the same now, but for how many slots there are."""
    from marl_sched.envs.ward.instance import Patient

    one = quiet(ward(waiting("early"), Patient(90, 0, "birth", high_risk=True), beds=(0, 1)))
    other = quiet(ward(waiting("early"), Patient(7, 1), beds=(0, 1)))
    assert TELEMETRY.messages(one) == TELEMETRY.messages(other)
    assert TELEMETRY.frame(one) == TELEMETRY.frame(other)

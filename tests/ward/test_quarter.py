"""What happens in a quarter of an hour, with numbers worked out by hand and against a reference in plain Python."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.envs.ward.instance import STAGES, Patient, generate
from marl_sched.envs.ward.simulator import WardSimulator
from marl_sched.errors import IllegalActionError, InvalidOptionError, UnknownNameError
from tests.ward.reference import ReferenceWard
from tests.ward.wards import play, quiet, waiting, ward


def test_who_waits_costs_by_her_stage_and_high_risk_counts_twice():
    """Four quarters of an hour: early 0.5, active 2, birth at high risk 2 x 8."""
    simulator = quiet(ward(waiting("early"), waiting("active"), waiting("birth", high_risk=True)))
    assert play(simulator, 0, 0, 0, 0) == pytest.approx(-18.5)
    assert simulator.objectives()["cost"] == pytest.approx([18.5])
    assert simulator.truncated[0]
    assert not simulator.terminated[0]


def test_an_admission_takes_two_quarters_in_which_the_patient_has_care_and_nobody_else():
    """Patient 1, in active labour, has care from the start. Patient 2 waits in early labour, 0.5 an hour."""
    simulator = quiet(ward(waiting("active"), waiting("early"), beds=(0, 0)))
    assert play(simulator, 1) == pytest.approx(-0.25)
    assert simulator.time[0] == 2
    # Then patient 2 is admitted, and for two quarters patient 1 lies without care, 1 an hour.
    assert play(simulator, 2) == pytest.approx(-0.5)
    assert simulator.time[0] == 4


def test_a_walk_takes_a_quarter_for_each_section_and_the_patient_is_without_care_until_it_is_over():
    """Two quarters of walk, in which the patient has a bed and no care, 1 an hour; then two with care."""
    simulator = quiet(ward(waiting("active", section=2), beds=(0, 2)))
    assert play(simulator, 1) == pytest.approx(-0.5)
    assert simulator.time[0] == 4
    patient = simulator.state.patients[0, 1]
    assert (patient["section"], patient["bed"], patient["nurse"]) == (0, 0, 0)


def test_a_nurse_cares_for_four_units_of_load_birth_first_and_the_rest_goes_without():
    """In hour 2 birth (4) has the nurse for herself; active labour costs 1 an hour."""
    simulator = quiet(ward(waiting("active"), waiting("birth"), beds=(0, 0)), hours=2)
    play(simulator, 1, 2)
    assert play(simulator, 0, 0, 0, 0) == pytest.approx(-1.0)
    assert simulator.state.patients["attended"][0].tolist() == [False, False, True]
    assert simulator.agent_figures()["overloaded"][0, 0] == 0.5


def test_another_nurse_may_take_over_who_went_without_care_and_nobody_else():
    """Nurse 0 admits 1 and then 2, whose load of 8 leaves 2 without care."""
    simulator = quiet(ward(waiting("birth"), waiting("birth"), beds=(0, 0), nurses=(0, 0)), hours=2)
    play(simulator, 1)
    assert simulator.legal()[0].tolist() == [1, 0, 1]
    play(simulator, 0, 0)  # nurse 1 in both quarters in which nurse 0 is busy
    play(simulator, 2, 0, 0)
    assert simulator.time[0] == 4
    play(simulator, 0)
    assert simulator.acting[0] == 1
    assert simulator.legal()[0].tolist() == [1, 1, 0]  # while nurse 0 was with patient 2, patient 1 went without
    play(simulator, 0)
    play(simulator, 0)
    assert simulator.legal()[0].tolist() == [1, 0, 1]
    before = float(simulator.state.rows["cost"][0])
    play(simulator, 2)
    assert simulator.state.patients["nurse"][0, 1:].tolist() == [0, 1]
    play(simulator, *[0] * 4)
    assert float(simulator.state.rows["cost"][0]) == before


def test_without_a_free_bed_in_her_section_a_nurse_admits_nobody():
    simulator = quiet(ward(waiting("active"), waiting("early", section=1), beds=(0, 1), nurses=(0, 0, 1)))
    assert simulator.legal()[0].tolist() == [1, 1, 1]
    play(simulator, 1)
    assert simulator.legal()[0].tolist() == [1, 0, 0]  # nurse 1 knows that nurse 0 has chosen the bed
    play(simulator, 0)
    assert simulator.legal()[0].tolist() == [1, 0, 1]


def test_nobody_leaves_recovery_and_her_bed_without_care():
    instance = ward(waiting("recovery"), beds=(0,))
    alone = WardSimulator([instance], horizon=50)
    play(alone, *[0] * 200)
    assert alone.objectives()["discharged"][0] == 0
    cared_for = WardSimulator([instance], horizon=50)
    play(cared_for, 1, *[0] * 50)
    assert cared_for.state.rows["discharged"][0] == 1
    assert cared_for.state.beds["patient"][0, 0] == 0
    assert cared_for.presence["patient"][0].tolist() == [True, False]


def test_patients_come_in_the_quarter_of_their_arrival():
    simulator = quiet(ward(Patient(2, 0, "birth")))
    assert simulator.legal()[0].tolist() == [1, 0]
    play(simulator, 0, 0)
    assert simulator.legal()[0].tolist() == [1, 1]
    assert simulator.state.rows["cost"][0] == 0


def test_the_census_counts_patient_hours():
    simulator = quiet(ward(waiting("early"), Patient(2, 0)), objective="census")
    assert play(simulator, 0, 0, 0, 0) == pytest.approx(-1.5)


def test_an_impossible_choice_does_nothing_and_is_a_conflict():
    simulator = quiet(ward(waiting("birth")))
    with pytest.raises(IllegalActionError, match=r"action 2: expected a patient's slot in \[0, 1\]"):
        play(simulator, 2)
    play(simulator, 1)
    late = quiet(ward(Patient(2, 0, "birth")))
    play(late, 1)
    assert late.conflict[0]
    assert late.time[0] == 1


def test_options_outside_their_range_are_named():
    instance = ward(waiting("birth"))
    with pytest.raises(UnknownNameError, match="unknown objective of ward 'cozt'; did you mean 'cost'"):
        WardSimulator([instance], objective="cozt")
    with pytest.raises(InvalidOptionError, match="horizon: expected an integer in"):
        WardSimulator([instance], horizon=0)
    small = WardSimulator([instance])
    with pytest.raises(InvalidOptionError, match=r"instances\[0\]: 2 patients exceed the padding of 1"):
        small.reset(instances=[ward(waiting("birth"), waiting("birth"))])


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), careless=st.booleans())
def test_a_day_is_that_of_the_reference(seed, careless):
    """Random choices, impossible ones included: costs, stages, beds, nurses and care agree at every turn."""
    rng = np.random.default_rng(seed)
    instance = generate("small", rng)
    simulator = WardSimulator([instance], horizon=12, seed=seed)
    reference = ReferenceWard(instance, np.uint64(simulator.episode_keys[0]))
    while simulator.acting[0] >= 0:
        assert simulator.acting[0] == reference.acting()
        slots = np.arange(simulator.max_actions) if careless else np.flatnonzero(simulator.legal()[0])
        action = int(rng.choice(slots))
        reference.choose(action)
        simulator.step(np.array([action]))
        if simulator.truncated[0]:
            break
        assert simulator.time[0] == reference.time
        _same(simulator.state.patients[0, 1:], reference.women)
    while reference.time < 48:
        reference.choose(0)
    assert simulator.state.rows["cost"][0] == pytest.approx(reference.cost, rel=1e-12)
    assert simulator.state.rows["census"][0] == pytest.approx(reference.census, rel=1e-12)


def _same(patients, women):
    for patient, woman in zip(patients, women, strict=True):
        assert patient["there"] == (woman.state in ("waiting", "in bed"))
        if patient["there"]:
            assert STAGES[patient["stage"]] == woman.stage
            assert patient["attended"] == woman.cared_for
            assert patient["section"] == woman.section
            assert patient["bed"] == (-1 if woman.bed is None else woman.bed)
            assert patient["nurse"] == (-1 if woman.nurse is None else woman.nurse)

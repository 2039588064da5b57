"""Instances, their generator and their files."""

import json

import numpy as np
import pytest

from marl_sched.envs.ward.instance import DAY, SCALES, decode, generate, load
from marl_sched.errors import InvalidFileError, UnknownNameError
from tests.ward.wards import waiting, ward


@pytest.mark.parametrize("scale", SCALES)
def test_generated_instances_keep_to_their_scale(scale):
    bounds = SCALES[scale]
    for seed in range(20):
        instance = generate(scale, np.random.default_rng(seed))
        assert bounds.nurses[0] <= len(instance.nurses) <= bounds.nurses[1]
        assert bounds.patients[0] <= len(instance.patients) <= bounds.patients[1]
        assert [instance.beds.count(section) for section in range(bounds.sections)] == [bounds.beds] * bounds.sections
        arrivals = [patient.arrival for patient in instance.patients]
        assert arrivals == sorted(arrivals)
        assert arrivals[-1] < DAY


def test_a_scale_that_is_not_there_is_named():
    with pytest.raises(UnknownNameError, match="unknown scale of ward 'smal'; did you mean 'small'"):
        generate("smal", np.random.default_rng(0))


def test_an_instance_comes_back_from_its_file(tmp_path):
    instance = generate("small", np.random.default_rng(3))
    instance.save(tmp_path / "ward.json")
    again = load(tmp_path / "ward.json")
    assert again == instance
    assert again.identity == instance.identity


def test_instances_that_differ_have_other_identities():
    early, first = ward(waiting("early")), ward(waiting("early", first=True))
    assert len({early.identity, first.identity, ward(waiting("early"), beds=(0, 0)).identity}) == 3


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("nurses", 0), 7, r"nurses[0]: expected a section that has a bed, one of [0, 1], got 7"),
        (("patients", 0, "section"), 5, "patients[0].section: expected a section that has a bed, one of [0, 1], got 5"),
        (("patients", 0, "stage"), "late", "patients[0].stage: expected a stage of labour, got 'late'"),
        (("patients", 0, "arrival"), -1, "patients[0].arrival: expected a quarter of an hour, an integer in"),
        (("beds", 1), 0.5, "beds[1]: expected a section, an integer in [0, 999], got 0.5"),
        (("schema",), 2, "schema: expected 1, got 2"),
    ],
)
def test_a_file_that_does_not_hold_a_ward_is_refused_with_the_field(path, value, message):
    data = json.loads(json.dumps(ward(waiting("birth"), beds=(0, 1)).as_json()))
    *way, last = path
    inner = data
    for step in way:
        inner = inner[step]
    inner[last] = value
    with pytest.raises(InvalidFileError) as caught:
        decode(data, "ward.json")
    assert str(caught.value).startswith(f"ward.json: {message}")

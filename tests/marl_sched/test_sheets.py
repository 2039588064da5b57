"""Spreadsheets: what they mean, and everything that is wrong in one at once."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.domain import get_domain
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES
from marl_sched.envs.airme.sheet import FLEET, with_crews
from marl_sched.envs.airme.type_files import read_types
from marl_sched.envs.murse.sheet import TASKS
from marl_sched.errors import InvalidFileError, InvalidSheetError
from marl_sched.sheet_reading import read_sheet

FLEET_CSV = (
    "tail,type,hours,landings,state,income\nD-A,fixed_wing,52,7,ready,12.5\nD-B,helicopter,18,2,broken,4\ncrews:,2\n"
)


def written(folder, text, name="sheet.csv", encoding="utf-8"):
    path = folder / name
    path.write_text(text, encoding=encoding)
    return path


def complaints(sheet, path):
    with pytest.raises(InvalidSheetError) as refused:
        read_sheet(sheet, path)
    return [line.removeprefix(f"{path}: ") for line in refused.value.lines]


@pytest.mark.parametrize("name", ["airme", "murse"])
def test_a_template_is_read_and_what_it_means_survives_its_json(name, tmp_path):
    domain = get_domain(name)
    instance = read_sheet(domain.sheet, written(tmp_path, domain.sheet.template()))
    instance.save(tmp_path / "instance.json")
    again = domain.load(tmp_path / "instance.json")
    assert again.as_json() == instance.as_json()
    assert again.identity == instance.identity


def test_a_fleet_is_what_its_rows_say(tmp_path):
    fleet = read_sheet(FLEET, written(tmp_path, FLEET_CSV))
    assert (fleet.n_crews, fleet.names) == (2, ("D-A", "D-B"))
    assert [kind.name for kind in fleet.types] == ["fixed_wing", "helicopter"]
    assert fleet.hours.tolist() == [52, 18]
    assert fleet.landings.tolist() == [7, 2]
    assert fleet.broken.tolist() == [False, True]
    assert fleet.income.tolist() == [12.5, 4.0]


def test_a_sheet_as_a_german_spreadsheet_saves_it_means_the_same(tmp_path):
    german = FLEET_CSV.replace(",", ";").replace("12.5", "12,5").replace("\n", "\r\n").replace("tail", "Tail ")
    one = read_sheet(FLEET, written(tmp_path, FLEET_CSV, "a.csv"))
    other = read_sheet(FLEET, written(tmp_path, german, "b.csv", "utf-8-sig"))
    assert one.as_json() == other.as_json()


def test_settings_given_go_before_those_of_the_file(tmp_path):
    assert read_sheet(FLEET, written(tmp_path, FLEET_CSV), {"crews": "5"}).n_crews == 5


def test_all_that_is_wrong_is_said_at_once_in_the_order_of_rows(tmp_path):
    bad = written(
        tmp_path,
        "tail,type,hours,landings,state,income\nA,fixed_wing,x,2,ready,3\nA,jet,1,-2,gone,\n"
        'B,fixed_wing,1,2,ready,"1,5",9\n# remark\nbeds:,3\n',
    )
    assert complaints(FLEET, bad) == [
        "row 2, column hours: expected an integer >= 0 and <= 1,000,000, got 'x'",
        "row 3, column landings: expected an integer >= 0 and <= 1,000,000, got '-2'",
        "row 3, column state: expected ready or broken, got 'gone'",
        "row 3, column income: expected a number > 0 and <= 1,000,000,000, got ''",
        "row 3, column tail: expected another one than in row 2, got 'A'",
        "row 3, column type: expected one of fixed_wing, helicopter, or a type of a file --types, got 'jet'",
        "row 4, column 7: expected nothing, as the column has no heading, got '9'",
        "row 4, column income: expected a number > 0 and <= 1,000,000,000, got '1,5'",
        "row 6: expected one of the settings crews, types, got 'beds:'",
        "expected the setting crews, given by --crews or in a row that begins with crews:",
    ]


def test_headings_that_are_missing_unknown_or_there_twice_are_named(tmp_path):
    bad = written(tmp_path, "tail,type,hours,hours,state,incomme\nA,fixed_wing,1,2,ready,1\n")
    assert complaints(FLEET, bad) == [
        "row 1, column hours: expected every heading once, got 'hours'",
        "row 1, column 6: expected one of the headings tail, type, hours, landings, state, income "
        "(did you mean income?), got 'incomme'",
        "row 1: expected a column landings",
        "row 1: expected a column income",
    ]


@pytest.mark.parametrize("content", [b"", b"\n\n", b"tail,type\n\xff\xfe", b'tail,"type\n'])
def test_what_is_no_table_is_refused_with_its_place(content, tmp_path):
    path = tmp_path / "sheet.csv"
    path.write_bytes(content)
    with pytest.raises(InvalidFileError, match=r"sheet\.csv: "):
        read_sheet(FLEET, path)


@settings(max_examples=60, deadline=None)
@given(text=st.text(alphabet=st.sampled_from('tailype,;\t"\n:#0-9. '), max_size=80))
def test_whatever_a_file_holds_it_is_read_or_refused(text, tmp_path_factory):
    path = tmp_path_factory.mktemp("sheet") / "sheet.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidFileError):
        read_sheet(FLEET, path)


def test_tasks_are_what_their_rows_say(tmp_path):
    """Robot arm and Ann; seal waits five after drill, only Ann can seal; nobody else's cells are eligible."""
    plant = read_sheet(TASKS, written(tmp_path, TASKS.template()))
    assert plant.called == (["drill", "seal", "inspect"], ["arm", "Ann"])
    assert plant.mean_durations.tolist() == [[20, 25], [-1, 18], [12, 15]]
    assert plant.waits.tolist() == [[1, 0, 5], [2, 0, 0], [2, 1, 0]]
    assert plant.deadlines.tolist() == [-1, 90, 120]
    assert plant.near.sum() == 0  # 3 and 4 apart, safety 1
    assert plant.durations == "stochastic"


def test_waits_that_name_no_task_or_form_a_circle_are_told(tmp_path):
    bad = written(tmp_path, "task,robot a,after\nA,1,B+2\nB,1,A & C\nD,,\n")
    assert complaints(TASKS, bad) == [
        "row 2, column after: expected tasks that do not wait for one another in a circle, got 'A -> B -> A'",
        "row 3, column after: expected names of tasks, each with +TIME or not, parted by &, got 'C'",
        "row 4: expected a duration of at least one robot or human",
    ]


def test_types_of_a_file_have_their_landings_part_first_and_fly_in_the_fleet(tmp_path):
    parts = [
        {"name": "engine", "wears_with": "hours", "scale": 240, "shape": 2.5},
        {"name": "gear", "wears_with": "landings", "scale": 90, "shape": 2},
    ]
    types = written(tmp_path, json.dumps({"schema": 1, "types": [{"name": "turboprop", "parts": parts}]}), "types.json")
    sheet = written(tmp_path, FLEET_CSV.replace("helicopter", "turboprop"))
    fleet = read_sheet(FLEET, sheet, {"types": str(types)})
    own = fleet.types[1]
    assert (own.name, own.parts, own.scales, own.shapes) == ("turboprop", ("gear", "engine"), (90, 240), (2, 2.5))
    assert (own.hour_norm, own.income) == (1.0, (4.0, 4.0))
    fleet.save(tmp_path / "fleet.json")
    assert get_domain("airme").load(tmp_path / "fleet.json").types[1].parts == ("gear", "engine")


def test_the_template_of_types_holds_the_published_ones(tmp_path):
    setting = next(one for one in FLEET.settings if one.name == "types")
    assert read_types(written(tmp_path, setting.template(), "types.json")) == PUBLISHED_TYPES


def test_two_parts_that_wear_with_landings_are_refused(tmp_path):
    part = {"name": "gear", "wears_with": "landings", "scale": 9, "shape": 2}
    data = {"schema": 1, "types": [{"name": "x", "parts": [part, {**part, "name": "tyre"}]}]}
    with pytest.raises(InvalidFileError, match=r"types\[0\]\.parts: expected at most one part that"):
        read_types(written(tmp_path, json.dumps(data), "types.json"))


def test_more_crews_meet_the_same_noise():
    fleet = get_domain("airme").instances("small", 1, 4)[0]
    more = with_crews(fleet, fleet.n_crews + 1)
    assert (more.n_crews, more.identity) == (fleet.n_crews + 1, fleet.identity)
    simulators = [get_domain("airme").simulator([one], horizon=9, seed=1) for one in (fleet, more)]
    assert np.array_equal(*(simulator.episode_keys for simulator in simulators))

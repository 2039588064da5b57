"""Instances and their files: what is read back is what was written, and a bad file is named with its line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from marl_sched.envs.murse import formats
from marl_sched.envs.murse.generate import SCALES, generate
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError

PUBLISHED = {
    ".txt": "3 1 1 5 15 100 0.25 0.25\n",
    "_dur.txt": "32 54\n49 33\n17 33\n",
    "_human.txt": "51 17 3 18 10 1\n27 3 6 22 45 10\n18 4 13 4 74 10\n",
    "_ddl.txt": "2 90\n",
    "_wait.txt": "3 1 4\n",
    "_loc.txt": "4 3\n1 4\n5 2\n",
}


def published(folder: Path, **changed: str) -> Path:
    """A published set in which the files named (without .txt) hold something else."""
    for part, text in PUBLISHED.items():
        text = changed.get(part.removesuffix(".txt").removeprefix("_") or "head", text)
        (folder / f"p{part}").write_bytes(text.encode())
    return folder / "p.txt"


@pytest.mark.parametrize("scale", ["small", "robots-small", "heterogeneous-5-small", "weighted-5-small"])
def test_json_gives_the_instance_back(scale, tmp_path):
    instance = generate(scale, np.random.default_rng(4))
    instance.save(tmp_path / "a.json")
    again = formats.load(tmp_path / "a.json")
    assert again.identity == instance.identity
    again.save(tmp_path / "b.json")
    assert (tmp_path / "a.json").read_text() == (tmp_path / "b.json").read_text()


def test_published_files_are_read_as_described(tmp_path):
    instance = formats.load(published(tmp_path))
    assert (instance.n_robots, instance.n_humans, instance.proximity) == (1, 1, "none")
    # Humans take int(c + k), whatever the duration file says.
    assert instance.mean_durations.tolist() == [[32, 54], [49, 33], [17, 31]]
    assert instance.deadlines.tolist() == [-1, 90, -1]
    assert instance.waits.tolist() == [[2, 0, 4]]
    assert instance.locations.tolist() == [[4, 3], [1, 4], [5, 2]]


def test_published_files_give_the_instance_back(tmp_path):
    instance = generate("small", np.random.default_rng(1))
    formats.write_published(instance, tmp_path / "x.txt")
    again = formats.read_published(tmp_path / "x.txt")
    assert again.identity == instance.identity
    assert again.mean_durations.tolist() == instance.mean_durations.tolist()


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"head": "3 1 1 5 15 100\n"}, "p.txt: line 1: expected at least 8 columns"),
        ({"head": ""}, "p.txt: line 1: expected tasks robots humans"),
        ({"dur": "32 54\n49 33\n17\n"}, "p_dur.txt: line 3: expected 2 columns"),
        ({"dur": "32 54\n-49 33\n17 33\n"}, "p_dur.txt: line 2: expected whole durations, none of them negative"),
        ({"dur": "32 54\n49 33\n"}, "p_dur.txt: line 2: expected 3 lines, one per task, got 2"),
        ({"dur": "32 54\n49 x\n17 33\n"}, "p_dur.txt: line 2: expected whole durations, got 'x'"),
        ({"human": "51 17 3 18 10 1\n27 3 6 22 45\n18 4 13 4 74 10\n"}, "p_human.txt: line 2: expected 6 columns"),
        ({"ddl": "2 90\n4 80\n"}, "p_ddl.txt: line 2: expected a task in 1..3, got 4"),
        ({"ddl": "0 90\n"}, "p_ddl.txt: line 1: expected a task in 1..3, got 0"),
        ({"wait": "3 1 4\n\n1 3 2\n"}, "p_wait.txt: line 3: expected waits without a cycle, got '1 -> 3 -> 1'"),
        ({"wait": "2 2 1\n"}, "p_wait.txt: line 1: expected waits without a cycle"),
        ({"wait": "3 1\n"}, "p_wait.txt: line 1: expected 3 columns"),
        ({"loc": "4 3\n1 4\n5 é\n"}, "p_loc.txt: line 3: expected ASCII text"),
        ({"loc": "4 3\n1 4\n5 nan\n"}, "p_loc.txt: line 3: expected x y"),
    ],
)
def test_bad_published_file_is_named_with_its_line(changed, complaint, tmp_path):
    with pytest.raises(InvalidFileError) as error:
        formats.load(published(tmp_path, **changed))
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_published_file_is_named(tmp_path):
    path = published(tmp_path)
    (tmp_path / "p_wait.txt").unlink()
    with pytest.raises(InvalidFileError, match=r"p_wait\.txt: expected a readable file"):
        formats.load(path)


def test_job_shop_becomes_machines_that_are_eligible_for_their_operations(tmp_path):
    (tmp_path / "two").write_text("# two jobs\n2 2\n0 3 1 2\n1 4 0 1\n")
    instance = formats.load(tmp_path / "two")
    assert instance.robot_durations.tolist() == [[3, -1], [-1, 2], [-1, 4], [1, -1]]
    assert instance.eligible.tolist() == [[True, False], [False, True], [False, True], [True, False]]
    assert instance.waits.tolist() == [[1, 0, 0], [3, 2, 0]]


def test_flexible_job_shop_keeps_the_choice_of_machine(tmp_path):
    (tmp_path / "mk.fjs").write_text("2 3 2\n2 2 1 5 3 4 1 2 1\n1 1 3 6\n")
    instance = formats.load(tmp_path / "mk.fjs")
    assert instance.robot_durations.tolist() == [[5, -1, 4], [-1, 1, -1], [-1, -1, 6]]
    assert instance.waits.tolist() == [[1, 0, 0]]


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a", "2 2\n0 3 1 2\n", "line 2: expected 2 lines of jobs, got 1"),
        ("a", "1 2\n0 3 1\n", "line 2: expected 4 columns"),
        ("a", "1 2\n0 3 2 5\n", "line 2: expected machines in 0..1, got 2"),
        ("a", "1 2\n0 -3 1 5\n", "line 2: expected machines and durations, none of them negative, got '-3'"),
        ("a", "1 2\n1 3 2 5\n", "0..1 (this seems to be a job shop whose machines are counted from 1), got 2"),
        (
            "a",
            "2 2 1\n1 1 1 3\n1 1 0 4\n",
            "machines in 1..2 (this seems to be a flexible job shop whose machines are counted from 0), got 0",
        ),
        ("a", "1 2 1\n1 1 1 3\n0 4\n4 0\n", "line 3: expected 1 lines of jobs and nothing more; further tables are"),
        ("a", "1 2\n0 3 1\n0 1 1 4\n1 2 3 4 5\n", "set-up times (SDST) or assembly"),
        ("a", "0 2\n", "line 1: expected at least one job and one machine, got '0 2'"),
        ("a.fjs", "1 2\n2 1 1 3\n", "line 2: expected 2 operations with at least one machine each, got '1'"),
        ("a.fjs", "1 2\n1 1 1 3 9\n", "line 2: expected nothing after 1 operations, got '9'"),
    ],
)
def test_bad_shop_file_is_named_with_its_line(name, text, complaint, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidFileError) as error:
        formats.load(tmp_path / name)
    assert complaint in str(error.value)


def test_taillards_format_is_told_by_its_two_tables(tmp_path):
    heading = "Nb of jobs, Nb of Machines\n"
    for text in ("2 2\nTimes\n3 2\n4 1\nMachines\n1 2\n2 1\n", "2 2\n3 2\n4 1\n1 2\n2 1\n"):
        (tmp_path / "ta").write_text(text)
        instance = formats.load(tmp_path / "ta")
        assert instance.robot_durations.tolist() == [[3, -1], [-1, 2], [-1, 4], [1, -1]]
        assert instance.waits.tolist() == [[1, 0, 0], [3, 2, 0]]
    (tmp_path / "ta").write_text(heading + "2 2\nTimes\n3 2\n4 1\nMachines\n1 2\n2 1\n")
    assert formats.load(tmp_path / "ta").n_tasks == 4


def test_a_flexible_job_shop_is_told_by_its_content_whatever_its_name(tmp_path):
    (tmp_path / "mk.txt").write_text("2 3\n2 2 1 5 3 4 1 2 1\n1 1 3 6\n")
    assert formats.load(tmp_path / "mk.txt").robot_durations.tolist() == [[5, -1, 4], [-1, 1, -1], [-1, -1, 6]]


def test_an_operation_may_take_no_time(tmp_path):
    (tmp_path / "orb").write_text("1 2\n0 3 1 0\n")
    instance = formats.load(tmp_path / "orb")
    assert instance.robot_durations.tolist() == [[3, -1], [-1, 0]]
    assert instance.eligible.tolist() == [[True, False], [False, True]]
    instance.save(tmp_path / "orb.json")
    assert formats.load(tmp_path / "orb.json").identity == instance.identity


def test_in_files_of_the_first_schema_a_duration_of_0_is_ineligible(tmp_path):
    two_tasks(robot_durations=[[4, -1], [0, 8]]).save(tmp_path / "new.json")
    assert [task["robots"] for task in json.loads((tmp_path / "new.json").read_text())["tasks"]] == [[4, None], [0, 8]]
    assert formats.load(tmp_path / "new.json").eligible.tolist() == [[True, False], [True, True]]
    old = edited(
        tmp_path / "new.json", lambda d: (d.__setitem__("schema", 1), d["tasks"][0].__setitem__("robots", [4, 0]))
    )
    assert formats.load(old).eligible.tolist() == [[True, False], [False, True]]


def test_a_folder_offers_every_file_that_should_hold_an_instance(tmp_path):
    for name in ("b.json", "a.fjs", "ta01", "7.txt", "7_dur.txt", "7_wait.txt", "README.md", "LICENSE", ".hidden"):
        (tmp_path / name).touch()
    assert [path.name for path in formats.instance_files(tmp_path)] == ["7.txt", "a.fjs", "b.json", "ta01"]


def edited(path: Path, edit) -> Path:
    """The JSON file after `edit` changed its data."""
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))
    return path


@pytest.mark.parametrize(
    ("edit", "complaint"),
    [
        (lambda d: d["tasks"][2].pop("location"), "tasks[2]"),
        (
            lambda d: d["tasks"][0]["robots"].__setitem__(0, -3),
            "tasks[0].robots[0]: expected an integer in [0, 2**31), got -3",
        ),
        (
            lambda d: d["tasks"][1].__setitem__("deadline", "soon"),
            "tasks[1].deadline: expected an integer in [0, 2**31), got 'soon'",
        ),
        (lambda d: d.__setitem__("proximity", "far"), ", got 'far'"),
        (lambda d: d.__setitem__("colour", 1), "colour: expected one of schema, env, n_robots"),
        (lambda d: d.__setitem__("schema", 9), "schema: expected 1 or 2, got 9"),
        (lambda d: d["tasks"][0]["robots"].append(4), "tasks[0].robots"),
        (lambda d: d["tasks"][0].__setitem__("waits", [{"after": 1, "time": 3}]), "tasks 1 -> 1 wait for one another"),
    ],
)
def test_bad_json_is_named_with_its_field(edit, complaint, tmp_path):
    generate("small", np.random.default_rng(2)).save(tmp_path / "a.json")
    with pytest.raises(InvalidFileError) as error:
        formats.load(edited(tmp_path / "a.json", edit))
    assert complaint in str(error.value)
    assert "a.json" in str(error.value)


def two_tasks(**changed: object) -> MurseInstance:
    values: dict[str, object] = {
        "robot_durations": [[4], [8]],
        "curves": np.zeros((2, 0, 6)),
        "deadlines": [-1, -1],
        "waits": [],
        "locations": np.zeros((2, 2)),
        "weights": [1, 1],
    }
    return MurseInstance(**(values | changed))


def test_hopeless_deadline_is_reported_with_the_chain_of_waits():
    assert two_tasks(deadlines=[-1, 14], waits=[(1, 0, 2)]).impossibilities() == []
    reasons = two_tasks(deadlines=[-1, 13], waits=[(1, 0, 2)]).impossibilities()
    assert reasons == ["task 2: deadline 13 but no finish before 14"]


def test_cyclic_waits_and_tasks_for_nobody_are_refused():
    with pytest.raises(InvalidOptionError, match="tasks 1 -> 2 -> 1 wait for one another"):
        two_tasks(waits=[(1, 0, 2), (0, 1, 0)])
    with pytest.raises(InvalidOptionError, match=r"tasks\[1\]: no agent is eligible"):
        two_tasks(robot_durations=[[4], [-1]])


@pytest.mark.parametrize("scale", list(SCALES))
def test_generated_instances_keep_their_scale_and_have_no_hopeless_deadline(scale):
    bounds = SCALES[scale]
    for seed in range(5):
        instance = generate(scale, np.random.default_rng([7, seed]))
        assert bounds.tasks[0] <= instance.n_tasks <= bounds.tasks[1]
        assert bounds.agents[0] <= instance.n_agents <= bounds.agents[1]
        assert not bounds.with_humans or min(instance.n_robots, instance.n_humans) >= 1
        assert instance.impossibilities() == []


def test_alike_robots_are_alike_and_others_are_not():
    alike = generate("homogeneous-5-small", np.random.default_rng(0)).robot_durations
    mixed = generate("heterogeneous-5-small", np.random.default_rng(0)).robot_durations
    assert (alike == alike[:, :1]).all()
    assert np.ptp(mixed, axis=1).max() in range(1, 7)


def test_a_quarter_of_the_tasks_waits():
    instances = [generate("robots-large", np.random.default_rng([3, i])) for i in range(20)]
    share = sum(len(set(i.waits[:, 0])) for i in instances) / sum(i.n_tasks for i in instances)
    assert share == pytest.approx(0.25, abs=0.03)


def test_generating_stops_when_nothing_is_accepted():
    with pytest.raises(InvalidOptionError, match="none of 1000 instances was accepted"):
        generate("small", np.random.default_rng(0), accept=lambda instance: False)


def test_unknown_scale_lists_the_known_ones():
    with pytest.raises(UnknownNameError, match="did you mean 'small'"):
        generate("smal", np.random.default_rng(0))


def test_identity_ignores_settings_and_sees_every_number():
    assert two_tasks().identity == two_tasks(proximity="none", durations="stochastic", n_rounds=7).identity
    assert two_tasks().identity != two_tasks(robot_durations=[[4], [9]]).identity
    assert two_tasks().identity != two_tasks(waits=[(1, 0, 0)]).identity

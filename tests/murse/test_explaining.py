"""Why schedules fail, in sentences worked out by hand; files of schedules are checked field by field."""

import copy

import pytest

from marl_sched.envs.murse.explaining import explain
from marl_sched.envs.murse.gantt import gantt_figure
from marl_sched.envs.murse.schedule import schedule
from marl_sched.envs.murse.schedule_files import SCHEDULES
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.errors import InvalidFileError
from tests.murse.problems import played, three_tasks


def data(**changes):
    return schedule(played(MurseSimulator([three_tasks(**changes)]), [1, 2, 3]))


def test_a_late_task_is_traced_back_to_what_holds_it_up():
    """Robot 0 does task 1 in [0, 4); task 2 is too close to it, so robot 1 does it in [4, 7), a unit late."""
    assert explain(data(deadlines=[-1, 6, 11])) == [
        "task 2 ends at 7, 1 after its deadline 6: robot 1 does it in 3 from 4 on, "
        "since task 1, too close to overlap, ends at 4"
    ]


def test_a_feasible_schedule_has_nothing_to_explain_and_is_confirmed():
    good = data()
    assert good["feasible"]
    assert explain(good) == SCHEDULES.problems(good) == []


def test_what_was_left_out_is_told_with_what_it_waits_for():
    cut = data()
    waiting = [task for task, one in enumerate(cut["tasks"], start=1) if one["waits"]]
    cut["dispatch"] = [job for job in cut["dispatch"] if job["task"] not in (1, *waiting)]
    sentences = explain(cut)
    assert "task 1 was not done: nobody took it" in sentences
    assert len(sentences) == 3 - len(cut["dispatch"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(makespan=3), "makespan: the file says 3"),
        (lambda d: d["dispatch"][2].update(start=d["dispatch"][2]["start"] + 5), "is not start"),
        (lambda d: d["dispatch"].pop(), "task 3: dispatched 0 times"),
    ],
)
def test_what_a_file_says_wrongly_is_found(change, words):
    wrong = copy.deepcopy(data())
    change(wrong)
    assert any(words in problem for problem in SCHEDULES.problems(wrong))


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda d: d["dispatch"][0].update(task=9), r"dispatch\[0\]\.task: expected a task in 1\.\.3, got 9"),
        (lambda d: d["dispatch"][0].update(agent=7), r"dispatch\[0\]\.agent: expected an agent in 0\.\.1, got 7"),
        (
            lambda d: d["dispatch"][0].pop("start"),
            r"dispatch\[0\]\.start: expected an integer >= 0; the field is missing",
        ),
        (lambda d: d.update(tasks=[]), r"tasks: "),
    ],
)
def test_a_file_that_is_no_schedule_is_refused_by_field(change, place):
    wrong = copy.deepcopy(data())
    change(wrong)
    with pytest.raises(InvalidFileError, match=f"^x.json: {place}"):
        SCHEDULES.decode(wrong, "x.json")


def test_charts_share_their_axis_and_explain_their_marks():
    pytest.importorskip("matplotlib")
    late, good = data(deadlines=[-1, 6, 11]), data()
    figure = gantt_figure({"late": late, "good": good})
    assert figure.axes[0].get_xlim() == figure.axes[1].get_xlim()
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "robot" in words
    assert "deadline of the task" in words
    assert "task ends after its deadline" in words
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[1] == f"good: round 1, makespan {good['makespan']}, feasible"

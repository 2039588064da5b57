"""Advice for a fleet and for a plant: what to do now, why, and what the time to come looks like."""

import json

import numpy as np
import pytest

from marl_sched.domain import get_domain
from marl_sched.planning import Measure
from marl_sched.problem import Problem
from marl_sched.train.evaluation.advice import _joined, compare_futures, play_futures
from tests.cli.pages import assert_well_formed

FLEET = (
    "tail,type,hours,landings,state,income\nD-A,fixed_wing,20,3,broken,5\nD-<B>,fixed_wing,90,12,ready,8\n"
    "D-C,helicopter,5,1,broken,9\ncrews:,2\n"
)


@pytest.fixture
def fleet(tmp_path):
    (tmp_path / "fleet.csv").write_text(FLEET)
    return tmp_path / "fleet.csv"


def test_free_crews_are_told_what_the_rule_ranks_first_and_why(run, fleet, tmp_path):
    """Corrective serves broken aircraft by income: D-C with 9 first, then D-A with 5; D-<B> is not broken."""
    words = ("--futures", 4, "--ahead", 2, "--json", tmp_path / "a.json", "--html", tmp_path / "a.html")
    ended = run("advise", fleet, "--scheduler", "corrective,condition", "--crews", "+1", *words)
    assert ended.code == 0, ended.err
    data = json.loads((tmp_path / "a.json").read_text())
    base = data["variants"]["corrective"]
    assert [(one["agent"], one["choice"]) for one in base["now"]] == [("crew_0", "D-C"), ("crew_1", "D-A")]
    assert base["now"][0]["candidates"][0]["worth"] == pytest.approx(9.0)
    assert {one["choice"]: one["worth"] for one in base["now"][0]["candidates"]}["D-<B>"] is None
    assert base["now"][0]["candidates"][0]["state"] == "broken"
    assert [len(steps) for steps in base["ahead"].values()] == [2] * 4
    assert all(step["low"] <= step["median"] <= step["high"] for steps in base["ahead"].values() for step in steps)
    assert list(data["what_if"]) == ["condition", "corrective, crews +1"]
    assert len(data["variants"]["corrective, crews +1"]["now"]) == 3
    page = (tmp_path / "a.html").read_text()
    assert "D-&lt;B&gt;" in page
    assert "D-<B>" not in page
    assert "<script" not in page
    assert "http://" not in page.replace("http://www.w3.org/", "")  # nothing is loaded from elsewhere
    assert_well_formed(page)
    assert "what if" in ended.out


def test_what_if_nothing_changes_shows_no_difference_in_any_future():
    """Two fleets that differ by a crew that the rule never needs meet the same noise: their futures are the same."""
    domain = get_domain("airme")
    problem = Problem(domain, count=1, seed=2)
    more = domain.sheet.settings[0].changes(problem.instances[0], 60)
    most = domain.sheet.settings[0].changes(problem.instances[0], 61)
    from marl_sched.agents.registry import create_scheduler

    one, other = (
        play_futures(
            problem.but(instances=[fleet], pad=None),
            create_scheduler("corrective", domain),
            domain.advice,
            count=3,
            steps=2,
        )
        for fleet in (more, most)
    )
    for difference in compare_futures(one, other).values():
        assert difference["mean"] == difference["low"] == difference["high"] == 0.0


def test_units_are_joined_to_steps_by_sum_or_mean():
    values = np.array([[1.0, 2.0, 3.0, 4.0, 9.0]])
    assert _joined(Measure(values, "sum", "higher"), 2, 2).tolist() == [[3.0, 7.0]]
    assert _joined(Measure(values, "mean", "higher"), 2, 2).tolist() == [[1.5, 3.5]]
    assert _joined(Measure(np.array([[np.nan, 4.0]]), "mean", "higher"), 1, 2).tolist()[0][1] == 4.0


def test_a_plant_is_advised_task_by_task(run, tmp_path):
    """Ann alone can seal, after the drill; the robot drills first, and the roll-out says what a choice would cost."""
    sheet = "task,robot a,human Ann,deadline,after\ndrill,20,25,,\nseal,,18,60,drill\n"
    (tmp_path / "tasks.csv").write_text(sheet)
    ended = run("advise", tmp_path / "tasks.csv", "--scheduler", "lst", "--futures", 2, "--json", tmp_path / "a.json")
    assert ended.code == 0, ended.err
    now = json.loads((tmp_path / "a.json").read_text())["variants"]["lst"]["now"]
    assert (now[0]["agent"], now[0]["choice"]) == ("a", "drill")
    assert now[0]["candidates"][0]["duration"] == 20
    assert now[0]["worths"] == "cost of what follows, by lst-rollout, while lst tells none"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--crews", "-2"), "--crews -2: expected at least 1 left, got 0"),
        (("--planes", "+1"), "--planes +1: expected a what-if of --crews"),
        (("--scheduler", "nobody"), "unknown scheduler 'nobody'"),
    ],
)
def test_what_cannot_be_advised_is_refused(run, fleet, words, message):
    ended = run("advise", fleet, *(() if "--scheduler" in words else ("--scheduler", "condition")), *words)
    assert (ended.code, message in ended.err) == (2, True), ended.err

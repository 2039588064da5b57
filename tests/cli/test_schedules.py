"""One instance, scheduled, explained, drawn and checked."""

import csv
import json

import pytest

from tests.cli.pages import assert_well_formed

SHEET = "task,robot a,human <b>Ann</b>,deadline,after\n<i>drill</i>,20,25,,\nseal,,18,30,<i>drill</i>+5\n"


def test_a_sheet_is_scheduled_explained_drawn_and_validated(run, tmp_path):
    """Seal starts 5 after drill's end at 20 and takes Ann 18: it ends at 43, 13 late; nothing can end it before."""
    (tmp_path / "tasks.csv").write_text(SHEET)
    out = tmp_path / "out"
    ended = run("schedule", tmp_path / "tasks.csv", "--scheduler", "lst,spt", "--out", out)
    assert ended.code == 0, ended.err
    assert "no schedule can be feasible" in ended.err
    assert "lst: task 2 (seal) ends at 43, 13 after its deadline 30" in ended.out
    written = {path.name for path in out.iterdir()}
    assert written == {"lst.json", "lst.csv", "spt.json", "spt.csv", "gantt.png", "gantt.svg", "schedule.html"}
    rows = list(csv.DictReader((out / "lst.csv").open()))
    assert [(row["name"], row["agent"], row["start"], row["late by"]) for row in rows] == [
        ("<i>drill</i>", "a", "0", ""),
        ("seal", "<b>Ann</b>", "25", "13"),
    ]
    page = (out / "schedule.html").read_text()
    assert "&lt;b&gt;Ann&lt;/b&gt;" in page
    assert "<b>Ann" not in page
    assert "http://" not in page.replace("http://www.w3.org/", "")  # nothing is loaded from elsewhere
    assert_well_formed(page)
    ended = run("validate", out / "lst.json")
    assert (ended.code, "infeasible, as it says" in ended.out) == (1, True)


def test_a_job_shop_is_scheduled_with_the_gap_to_its_bound(run, tmp_path):
    """Two jobs, machine 1 then 2: 3 and 4, the second operation of each 2 and 1; the best makespan is 3 + 4 + 1."""
    pytest.importorskip("ortools")
    (tmp_path / "shop.jsp").write_text("2 2\n0 3 1 2\n0 4 1 1\n")
    words = ("--scheduler", "spt", "--bound", "--time-limit", 30, "--out", tmp_path / "out")
    ended = run("schedule", tmp_path / "shop.jsp", *words)
    assert ended.code == 0, ended.err
    assert " ".join(["spt", "yes", "8", "8.00", "8.00", "0.00"]) in " ".join(ended.out.split()) or "0.00" in ended.out
    ended = run("validate", tmp_path / "out" / "spt.json")
    assert (ended.code, "confirmed, feasible yes, makespan 8" in ended.out) == (0, True)


def test_a_file_that_is_no_schedule_and_an_environment_without_any_are_refused(run, tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"env": "murse", "schema": 1}))
    ended = run("validate", tmp_path / "a.json")
    assert (ended.code, "a.json: round: expected an integer >= 0; the field is missing" in ended.err) == (2, True)
    run("generate", "airme", "--out", tmp_path / "p")
    ended = run("schedule", tmp_path / "p" / "airme-small-0-0000.json", "--scheduler", "condition")
    assert (ended.code, "the environment 'airme' has no schedules" in ended.err) == (2, True)

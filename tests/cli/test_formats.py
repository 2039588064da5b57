"""What is printed of results: no number is lost on a narrow terminal, in a pipe, in ASCII or on a full disk."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec import structs

from marl_sched.cli.tables import FORMATS, print_scores
from marl_sched.errors import InvalidOptionError, UnknownNameError
from marl_sched.privileged import PrivilegedInfo
from marl_sched.problem import Problem
from marl_sched.statistics import PairedDifference, Summary
from marl_sched.train.evaluation.results import Baseline, Measure, Reference, Results, SchedulerResults


def intervals(mean):
    return {
        "ci95_such_instances": (mean - 0.1, mean + 0.1),
        "ci95_these_instances": (mean - 0.01, mean + 0.01),
    }


def summary(mean):
    return Summary(mean=mean, std=0.0123, iqm=mean + 0.001, **intervals(mean))


def results(name="a-scheduler-with-a-name-that-is-longer-than-any-terminal-has-columns"):
    row = SchedulerResults(
        M1=summary(0.7123),
        scores=[[0.7, 0.7], [0.7, 0.7], [0.7, 0.7]],
        M2=summary(12.3),
        measures={one: Measure(mean=0.8, summary=summary(0.8)) for one in ("profit", "revenue")},
        difference=PairedDifference(mean=0.0456, std=0.0123, p=None, **intervals(0.0456)),
        visible_share=1.0,
        privileged_info=PrivilegedInfo.NONE,
        seconds=1.0,
    )
    return Results(
        problem=Problem("airme", count=3, episodes=2),
        baseline=Baseline(scheduler="corrective", view={"kind": "full"}),
        reference=Reference(scheduler="corrective", M1=summary(0.6)),
        schedulers={name: row, "x": structs.replace(row, M1=summary(0.9876))},
        by_instance=[],
    )


@pytest.mark.parametrize("columns", ["0", "20", "60", "80", "200"])
def test_no_terminal_is_too_narrow_for_a_number(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    print_scores(results())
    printed = capsys.readouterr().out
    for number in ("0.7123", "0.9876", "± 0.012", "[0.612, 0.812]", "(0.702, 0.722)", "+0.0456", "12.3"):
        assert number in printed
    assert "a-scheduler" in printed


def test_names_are_shortened_to_fit_into_80_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    print_scores(results())
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_csv_has_a_column_for_every_number_and_the_best_first(capsys):
    print_scores(results(), "csv")
    first, second = csv.DictReader(io.StringIO(capsys.readouterr().out))
    assert first["scheduler"] == "x"
    assert float(first["M1 mean"]) == 0.9876
    assert float(second["difference ci95_these_instances high"]) == 0.0456 + 0.01
    assert float(second["revenue std"]) == 0.0123


def test_json_is_the_results(capsys):
    print_scores(results(), "json")
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(results().as_json()))


def test_markdown_and_latex_hold_whole_names_and_all_measures(capsys):
    for style, mark in (("markdown", "|---"), ("latex", "\\toprule")):
        print_scores(results(), style)
        printed = capsys.readouterr().out
        assert mark in printed
        assert next(iter(results().schedulers)) in printed
        assert "revenue" in printed
        assert "0.7123 ± 0.012" in printed


def test_an_unknown_format_is_refused_with_the_known_ones():
    with pytest.raises(UnknownNameError, match=", ".join(sorted(FORMATS))):
        print_scores(results(), "html")


PROGRAM = """
import sys
from marl_sched.cli import evaluation
from marl_sched.cli.app import run
from tests.cli.test_formats import results
evaluation.play = lambda *arguments: results()
command = ["evaluate", "--env", "airme", "--schedulers", "random", "--instances", "1"]
sys.exit(run([*command, *sys.argv[1:]]))
"""


def evaluate(*options, **environment):
    """The command with the playing left out, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *options], cwd=Path(__file__).parents[2], capture_output=True, check=False,
        env={**os.environ, "PYTHONPATH": ".", "COLUMNS": "100", **environment},
    )  # fmt: skip


def test_scores_are_printed_in_ascii_where_nothing_else_is_possible():
    done = evaluate(PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert b"+/- 0.012" in done.stdout


def test_scores_are_printed_before_a_full_disk_is_met():
    done = evaluate("--json", "/dev/full")
    assert done.returncode == 2
    assert b"0.7123" in done.stdout
    assert done.stderr.strip() == b"error: /dev/full: No space left on device"


def test_a_dash_gives_standard_output_to_the_json_alone():
    done = evaluate("--json", "-")
    assert json.loads(done.stdout) == json.loads(json.dumps(results().as_json()))
    assert b"0.7123" in done.stderr


def test_one_path_for_folder_and_file_is_refused_before_anything_is_played(tmp_path):
    from typer.testing import CliRunner

    from marl_sched.cli.app import app

    both = str(tmp_path / "d")
    command = ["compare", "--env", "airme", "--schedulers", "random", "--out", both, "--json", both]
    with pytest.raises(InvalidOptionError, match="is the folder of --out, expected a file"):
        CliRunner().invoke(app, command, catch_exceptions=False, standalone_mode=False)
    assert list(tmp_path.iterdir()) == []

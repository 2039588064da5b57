"""Spreadsheets on the command line."""

import json

import pytest


@pytest.mark.parametrize("env", ["airme", "murse"])
def test_a_template_that_was_written_is_imported_without_naming_its_environment(run, env, tmp_path):
    assert run("template", env, "--out", tmp_path / "sheet.csv").code == 0
    ended = run("import", tmp_path / "sheet.csv", "--out", tmp_path / "problem.json")
    assert (ended.code, ended.err) == (0, "")
    assert json.loads((tmp_path / "problem.json").read_text())["env"] == env


def test_every_complaint_is_a_line_of_its_own_and_nothing_is_written(run, tmp_path):
    sheet = tmp_path / "sheet.csv"
    sheet.write_text("tail,type,hours,landings,state,income\nA,jet,x,2,ready,1\n")
    ended = run("import", sheet, "--crews", 2, "--out", tmp_path / "fleet.json")
    assert ended.code == 2
    assert [line.split(": expected")[0] for line in ended.err.splitlines()] == [
        f"error: {sheet}: row 2, column hours",
        f"error: {sheet}: row 2, column type",
    ]
    assert not (tmp_path / "fleet.json").exists()


def test_own_types_come_from_a_file(run, tmp_path):
    types = json.loads(run("template", "airme", "types").out)
    types["types"][0]["name"] = "jet"
    (tmp_path / "types.json").write_text(json.dumps(types))
    sheet = tmp_path / "sheet.csv"
    sheet.write_text("tail,type,hours,landings,state,income\nA,jet,1,2,ready,1\n")
    words = ("--crews", 2, "--types", tmp_path / "types.json", "--out", tmp_path / "fleet.json")
    assert run("import", sheet, *words).code == 0
    assert json.loads((tmp_path / "fleet.json").read_text())["types"][0]["name"] == "jet"


def test_settings_and_templates_that_there_are_not_are_refused_with_those_that_there_are(run, tmp_path):
    run("template", "airme", "--out", tmp_path / "sheet.csv")
    ended = run("import", tmp_path / "sheet.csv", "--crew", 2, "--out", tmp_path / "fleet.json")
    assert (ended.code, "did you mean 'crews'?" in ended.err) == (2, True)
    ended = run("template", "airme", "type")
    assert (ended.code, "did you mean 'types'?" in ended.err) == (2, True)


def test_a_sheet_of_no_environment_is_refused(run, tmp_path):
    (tmp_path / "sheet.csv").write_text("a,b\n1,2\n")
    ended = run("import", tmp_path / "sheet.csv", "--out", tmp_path / "fleet.json")
    assert (ended.code, "row 1: expected the headings of one of airme, murse" in ended.err) == (2, True)


def test_records_are_fitted_into_a_file_of_types_and_a_picture(run, tmp_path):
    (tmp_path / "records.csv").write_text(run("template", "airme", "records").out)
    words = ("--out", tmp_path / "types.json", "--plot", tmp_path / "fit.svg")
    ended = run("fit", tmp_path / "records.csv", *words)
    assert ended.code == 0, ended.err
    assert "turboprop" in ended.out
    assert "only with --failure hazard" in " ".join(ended.out.split())
    part = json.loads((tmp_path / "types.json").read_text())["types"][0]["parts"][0]
    assert (part["failures"], part["censored"]) == (2, 1)
    assert part["scale_interval"][0] < part["scale"] < part["scale_interval"][1]
    assert (tmp_path / "fit.svg").read_text().startswith("<?xml")


def test_a_picture_of_no_known_format_is_refused_before_the_work(run, tmp_path):
    (tmp_path / "records.csv").write_text(run("template", "airme", "records").out)
    ended = run("fit", tmp_path / "records.csv", "--plot", tmp_path / "fit.bmp")
    assert (ended.code, "--plot: expected a name that ends in .png, .svg, .pdf" in ended.err) == (2, True)

"""The page for planners: every command on it runs, on the files that stand on it."""

import re
import shlex
from pathlib import Path

import pytest

from marl_sched.cli import main

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "planners.md").read_text(encoding="utf-8")
FILE = re.compile(r"<!-- file: (\S+) -->\n```csv\n(.*?)```", re.DOTALL)
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)


SECTIONS = {
    "fleet": ("A fleet", "Your own aircraft types", ["fleet.json", "advice.html", "advice.json"]),
    "types": ("Your own aircraft types", "Tasks of a plant", ["types.json", "fit.png", "own.json"]),
    "plant": ("Tasks of a plant", "What the team", ["out/lst.json", "out/gantt.svg", "out/schedule.html"]),
    "team": ("What the team should do now", None, []),
}


@pytest.mark.parametrize("section", SECTIONS)
def test_every_command_of_the_page_runs(section, tmp_path, monkeypatch, capsys):
    pytest.importorskip("ortools")
    first, behind, written = SECTIONS[section]
    text = PAGE.split(f"\n## {first}\n")[1].split(f"\n## {behind}")[0]
    monkeypatch.chdir(tmp_path)
    for name, content in FILE.findall(text):
        Path(name).write_text(content, encoding="utf-8")
    commands = [line for block in SHELL.findall(text) for line in block.splitlines()]
    assert commands
    for line in commands:
        program, *words = shlex.split(line)
        assert program == "marl-sched"
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0, f"{line}: {capsys.readouterr().err}"
    assert all(Path(name).stat().st_size > 0 for name in written)


def test_what_the_page_shows_of_the_advice_is_so(tmp_path, monkeypatch, capsys):
    """Broken aircraft by income, then by hours: worked out from the sheet alone."""
    monkeypatch.chdir(tmp_path)
    Path("fleet.csv").write_text(dict(FILE.findall(PAGE))["fleet.csv"], encoding="utf-8")
    with pytest.raises(SystemExit):
        main(shlex.split("advise fleet.csv --scheduler condition --futures 2 --ahead 1"))
    out = capsys.readouterr().out
    shown = re.findall(r"^ +(crew_\d) +(\S+ \[.*?\]) +(\S+ \[.*?\]),", PAGE, re.MULTILINE)
    assert len(shown) == 2
    for words in shown:
        assert " ".join(words) in " ".join(out.split())


def test_the_errors_of_the_page_are_those_of_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = ["A,fixed_wing,1,1,ready,1", "B,fixed_wing,x,1,ready,1", "C,jet,1,1,ready,1", "crews:,1"]
    Path("fleet.csv").write_text("\n".join(["tail,type,hours,landings,state,income", *rows]), encoding="utf-8")
    with pytest.raises(SystemExit):
        main(["import", "fleet.csv", "--out", "fleet.json"])
    errors = capsys.readouterr().err
    assert errors in PAGE

"""The signatures of the public pages hold what their pages say, and a type checker refuses what they do not take."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from marl_sched import airme_v0, murse_v0, ward_v0
from marl_sched.domain import get_domain

ROOT = Path(__file__).parents[2]
PAGES = {"airme": airme_v0, "murse": murse_v0, "ward": ward_v0}
OPTIONS = {"airme": airme_v0.AirmeOptions, "murse": murse_v0.MurseOptions, "ward": ward_v0.WardOptions}


def table_of(page):
    """The option table of a page: name -> default as it is written."""
    lines = page.__doc__.split("| option | default | meaning |")[1].split("\n\n")[0].splitlines()[2:]
    return dict(re.match(r"\| `(\w+)` \| (.*?) \|", line).groups() for line in lines)


@pytest.mark.parametrize("name", PAGES)
def test_the_option_table_of_a_page_is_its_signature_with_its_defaults(name):
    defaults = PAGES[name].DEFAULTS
    written = {option: eval(default.strip("`"), {}) for option, default in table_of(PAGES[name]).items()}
    assert written == defaults
    assert set(OPTIONS[name].__annotations__) == set(defaults)


@pytest.mark.parametrize("name", PAGES)
def test_the_defaults_of_a_page_are_the_domains(name):
    domain, defaults = get_domain(name), PAGES[name].DEFAULTS
    assert defaults["horizon"] == domain.default_horizon
    assert defaults["objective"] == domain.objectives[0]
    assert defaults["scale"] == next(iter(domain.scales))


@pytest.mark.slow
def test_mypy_refuses_every_misuse_and_nothing_else(tmp_path):
    source = ROOT / "tests" / "typing" / "misused.py"
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), "--follow-imports=silent",
         "--cache-dir", str(tmp_path / "cache"), str(source)],
        cwd=tmp_path, env={**os.environ, "MYPYPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    refused = {int(number) for number in re.findall(r"misused\.py:(\d+): error", done.stdout)}
    lines = source.read_text().splitlines()
    assert refused == {number for number, line in enumerate(lines, 1) if line.endswith("# refused")}, done.stdout

"""What pyproject.toml and constraints.txt promise to those who install the package."""

import re
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
FOLDERS = ("marl_sched", "envs", "agents", "train", "comms", "configs")
REQUIREMENTS = [
    Requirement(line)
    for line in [
        *PROJECT["dependencies"],
        *(line for extra in PROJECT["optional-dependencies"].values() for line in extra),
    ]
    if not line.startswith("marl-sched")
]


def pins() -> dict[str, Version]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): Version(version) for name, version in pairs}


def test_constraints_are_plain_pins():
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        assert line.startswith("#") or re.fullmatch(r"[\w.-]+==\d[\w.]*", line), line


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_every_requirement_is_pinned_within_its_bound(requirement):
    assert pins()[canonicalize_name(requirement.name)] in requirement.specifier


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_requirements_have_lower_bounds_only(requirement):
    assert [part.operator for part in requirement.specifier] == [">="]


def test_core_needs_neither_torch_nor_zenoh():
    core = {canonicalize_name(Requirement(line).name) for line in PROJECT["dependencies"]}
    assert not core & {"torch", "torchrl", "tensordict", "eclipse-zenoh", "ortools", "matplotlib"}


def test_every_data_file_matches_a_pattern_that_ships_it():
    shipped = {Path(pattern).suffix for pattern in PYPROJECT["tool"]["setuptools"]["package-data"]["*"]}
    not_for_users = {".py", ".md"} | {".pyc", ".nbi", ".nbc"}  # pages for readers of the source; made by running
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and path.suffix not in not_for_users:
                assert path.suffix in shipped, f"{path.relative_to(ROOT)} would be left out of the wheel"


def test_command_line_starts_where_the_entry_point_says():
    (command,) = entry_points(group="console_scripts", name="marl-sched")
    assert callable(command.load())

"""Modules of the same names in the folder where a deployment is started are not imported."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SHORT = ("--scale", "small", "--hours", "3", "--policy", "condition", "--insecure", "--json", "report.json")
DEMO = """
from pathlib import Path
from marl_sched.cli.demo import _deploy, deployed_problem
from marl_sched.domain import get_domain
problem = deployed_problem(get_domain("airme"), "condition").but(horizon=3)
_deploy("condition", problem, Path("report.json"))
"""


@pytest.fixture
def foreign(tmp_path):
    """A folder whose modules take the names of ones that a deployment imports, and fail."""
    folder = tmp_path / "foreign"
    folder.mkdir()
    for name in ("queue", "zenoh", "msgspec", "marl_sched"):
        (folder / f"{name}.py").write_text(f"raise RuntimeError('the foreign {name}.py was imported')\n")
    return folder


def test_deploy_ignores_modules_of_the_current_folder(foreign):
    command = [Path(sys.executable).parent / "marl-sched", "deploy", *SHORT]
    done = subprocess.run(command, cwd=foreign, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads((foreign / "report.json").read_text())["ending"]["kind"] == "complete"


def test_the_demonstrations_deployment_ignores_them_too(foreign, tmp_path):
    script = tmp_path / "program.py"  # its folder, not the current one, is where Python looks first
    script.write_text(DEMO)
    done = subprocess.run([sys.executable, script], cwd=foreign, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert json.loads((foreign / "report.json").read_text())["ending"]["kind"] == "complete"

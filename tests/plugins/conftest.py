"""The distribution `tests/couriers`, installed as any other: found by its entry points, in this process and others."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import pytest

from marl_sched import domain
from marl_sched.cli import main

SOURCE = Path(__file__).resolve().parents[1] / "couriers"


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """A folder like site-packages, with the distribution installed."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "couriers"
    subprocess.run(["cp", "-r", SOURCE, source], check=True)  # building leaves files beside the sources
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", folder, source], check=True)
    return folder


@pytest.fixture
def installed(site, monkeypatch):
    """The distribution on the path of this process and of those that it starts."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))
    monkeypatch.setattr(domain, "_DOMAINS", dict(domain._DOMAINS))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", registry := dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", registry)
    yield
    for name in set(sys.modules) - before:
        if name.partition(".")[0] == "couriers":
            del sys.modules[name]


@pytest.fixture
def run(installed, capsys):
    """Run a command in this process, with the distribution there."""

    def run(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return Ended(int(ended.value.code or 0), said.out, said.err)

    return run

"""The examples of other packages on our environments; each runs where its package is installed."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

CLIENTS = Path(__file__).parents[2] / "examples" / "clients"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, CLIENTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(name: str, monkeypatch, *arguments: str) -> int:
    """The example's exit code."""
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
    return load(name).main()


def test_maskable_ppo_of_stable_baselines3_trains(monkeypatch, capsys):
    pytest.importorskip("sb3_contrib", reason="needs stable-baselines3 and sb3-contrib")
    assert run("sb3_maskable_ppo", monkeypatch, "--turns", "250", "--horizon", "50") == 0
    assert "0 forbidden" in capsys.readouterr().out

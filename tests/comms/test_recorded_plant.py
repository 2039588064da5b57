"""A plant that is not simulated: the example of recorded telemetry, and one in which nobody is asked for a while."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from marl_sched.comms.decision_log import Header
from marl_sched.comms.inproc import Threads
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.protocol.events import PlantAdvanced
from marl_sched.problem import Problem

EXAMPLE = Path(__file__).parents[2] / "examples" / "recorded_plant.py"


@pytest.fixture
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("recorded_plant", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def options(*, horizon=12, view="full", **changes) -> WorldOptions:
    problem = Problem("airme", count=1, horizon=horizon, view=view)
    return WorldOptions(**{"problem": problem, "deadline": 30.0, "ready_timeout": 30.0, **changes})


def test_agents_choose_on_recorded_telemetry_what_they_chose_when_it_was_recorded(example, tmp_path, monkeypatch):
    given, path = options(view={"kind": "local", "reach": 1, "comm": 1}), tmp_path / "recording.jsonl"
    example.record(path, given, "condition")
    monkeypatch.setenv("RECORDING", str(path))
    plant = example.make(given)
    report = Threads(given, ["condition"] * plant.n_agents, plant=plant).play()
    assert report.ending.kind == "complete"
    assert len(report.decisions) == plant.asked == len(plant.epochs) > 7
    assert report.M1 == 1.0


def test_plant_is_made_by_the_function_that_the_options_name(example, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLE.parent))
    example.record(tmp_path / "recording.jsonl", options(), "condition")
    monkeypatch.setenv("RECORDING", str(tmp_path / "recording.jsonl"))
    given = options(plant_factory="recorded_plant:make")
    assert given.plant().n_agents == 7
    assert Header.of(given).plant == "recorded_plant:make"


def test_plant_in_which_nobody_has_to_decide_is_asked_again_until_somebody_has(example, tmp_path):
    class Pausing(example.RecordedPlant):
        """Says three times between two decision epochs that there is nothing to decide."""

        pauses = 0

        def state(self) -> PlantAdvanced:
            state = super().state()
            self.pauses += 1
            return state if self.pauses % 4 == 0 else PlantAdvanced(state.tick, (), {})

        def apply(self, choices):
            return super().apply(choices) if choices else []

    given, path = options(horizon=2), tmp_path / "recording.jsonl"
    example.record(path, given, "condition")
    plant = Pausing(path, "profit")
    report = Threads(given, ["condition"] * plant.n_agents, plant=plant).play()
    assert len(report.decisions) == len(plant.epochs)
    assert plant.pauses >= 4 * len(plant.epochs)

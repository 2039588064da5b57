"""The bench: what it hands out, not how fast the machine is."""

import msgspec
import numpy as np
import pytest
import torch

from marl_sched.agents.airme.bench import play_hours, prepared_hours
from marl_sched.cli.app import run
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.train import bench

AIRME = get_domain("airme")


@pytest.fixture
def _small(monkeypatch):
    monkeypatch.setattr(bench, "BATCH", 3)
    monkeypatch.setattr(bench, "_AEC_TURNS", 20)
    monkeypatch.setattr(bench, "_TORCHRL_STEPS", 2)
    monkeypatch.setattr(bench, "_POLICY_DECISIONS", 2)


@pytest.mark.usefixtures("_small")
def test_the_figures_have_the_names_that_other_tools_read_and_say_what_they_are_of():
    threads = torch.get_num_threads()
    measured = bench.bench(AIRME, repeats=1)
    names = {"hour_us_b1", "hour_us_b3", "aec_turns_per_s", "torchrl_decisions_per_s"}
    names |= {"policy_ms_small", "policy_ms_large"}
    names |= {f"condition_hour_us_{planes}_planes_b{rows}" for planes in (30, 60, 120) for rows in (1, 3)}
    assert set(measured.figures) == names
    assert all(figure.value > 0 and figure.meaning for figure in measured.figures.values())
    assert {name for name, figure in measured.figures.items() if figure.better == "higher"} == {
        "aec_turns_per_s", "torchrl_decisions_per_s",
    }  # fmt: skip
    assert measured.calibration_ms > 0
    assert measured.threads == 1
    assert torch.get_num_threads() == threads


def figures(calibration_ms: float, turns: float, milliseconds: float, batch: int = 3) -> bench.Bench:
    return bench.Bench(
        env="airme",
        repeats=1,
        batch=batch,
        calibration_ms=calibration_ms,
        figures={
            "aec_turns_per_s": bench.Figure(turns, "higher", "turns"),
            "policy_ms_small": bench.Figure(milliseconds, "lower", "a decision"),
        },
    )


def test_a_machine_of_half_the_speed_makes_no_figure_slower():
    """The calibration takes twice as long, turns per second are halved and milliseconds doubled."""
    ratios = figures(10.0, 500.0, 4.0).against(figures(5.0, 1000.0, 2.0))
    assert ratios == {"aec_turns_per_s": 1.0, "policy_ms_small": 1.0}


def test_what_became_slower_on_the_same_machine_is_told_by_how_much():
    ratios = figures(5.0, 800.0, 2.2).against(figures(5.0, 1000.0, 2.0))
    assert ratios == pytest.approx({"aec_turns_per_s": 1.25, "policy_ms_small": 1.1})


def test_figures_of_another_batch_are_not_held_against_these():
    with pytest.raises(InvalidOptionError, match="batch: expected 3 as now, got figures of 4"):
        figures(5.0, 1.0, 1.0).against(figures(5.0, 1.0, 1.0, batch=4))


@pytest.mark.parametrize(("then", "code"), [(100.0, 0), (1.0, 1)])
def test_the_command_ends_with_1_where_a_figure_is_slower_and_says_which(tmp_path, capsys, monkeypatch, then, code):
    """Turns per second against a hundredth of them, and against a hundred times as many; the files are its own."""
    now = figures(5.0, 100.0, 1.0)
    monkeypatch.setattr(bench, "bench", lambda domain, repeats, batch: now)
    assert run(["bench", "--json", str(tmp_path / "now.json")]) == 0
    assert bench.read_bench(tmp_path / "now.json") == now
    (tmp_path / "then.json").write_bytes(msgspec.json.encode(figures(5.0, 100.0 * 100.0 / then, 1.0)))
    capsys.readouterr()
    assert run(["bench", "--against", str(tmp_path / "then.json")]) == code
    told = capsys.readouterr().out
    assert ("SLOWER" in told) == bool(code)


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.json"
    path.write_text('{"schema": 1, "env": "airme"}')
    with pytest.raises(InvalidFileError, match=r"other.json: expected figures of `marl-sched bench`, schema 2"):
        bench.read_bench(path)


def test_the_prepared_hours_replay_the_rules_own_episode():
    simulator, choices = prepared_hours(AIRME, 2)
    expected = simulator.objectives()["profit"].copy()
    simulator.reset(seed=0)
    play_hours(simulator, choices)
    np.testing.assert_array_equal(simulator.objectives()["profit"], expected)
    assert simulator.over.all()


def test_no_repeats_are_refused():
    with pytest.raises(InvalidOptionError, match="repeats"):
        bench.bench(AIRME, repeats=0)

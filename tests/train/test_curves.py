"""Learning curves of many runs: what is read, averaged, drawn and refused."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from marl_sched.cli.app import run as run_command
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.files import read_json, write_json
from marl_sched.train.config import RunRecord, load_config
from marl_sched.train.curves import learning_curves, trailing_mean
from marl_sched.train.evaluation.plots import curves_by_group


def made_up(directory: Path, *overrides: str, scores: list[float], every: int = 10) -> Path:
    """A run's folder whose update k is logged after 10 k seconds and `every` k simulated hours."""
    record = RunRecord(config=load_config(overrides), overrides=list(overrides), revision="")
    write_json(directory / "config.json", msgspec.to_builtins(record))
    rows = [f"{k},{10 * k},{every * k},{score},{score if k % 2 == 0 else ''}" for k, score in enumerate(scores, 1)]
    (directory / "progress.csv").write_text("\n".join(["update,seconds,hours,reward_rate,validation", *rows]) + "\n")
    return directory


def test_runs_of_an_algorithm_are_a_group_whose_mean_goes_as_far_as_all_of_them(tmp_path: Path):
    runs = [
        made_up(tmp_path / "a", "seed=3", scores=[0.1, 0.2, 0.3, 0.4]),
        made_up(tmp_path / "b", "seed=4", scores=[0.3, 0.4, 0.5]),
        made_up(tmp_path / "c", "algorithm=step_baseline", scores=[0.6, 0.6]),
    ]
    curves = learning_curves(runs, smooth=1)
    assert list(curves["groups"]) == ["gae", "step_baseline"]
    group = curves["groups"]["gae"]
    assert [(run["run"], run["seed"]) for run in group["runs"]] == [("a", 3), ("b", 4)]
    assert group["runs"][0]["y"] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert group["mean"]["x"] == [1, 2, 3]
    assert group["mean"]["y"] == pytest.approx([0.2, 0.3, 0.4])


def test_a_mean_over_simulated_hours_reads_between_the_points_of_a_run(tmp_path: Path):
    # b is logged at 15, 30, 45 hours, a at 10, 20, 30, 40; a has 0.15 at 15 hours and 0.3 at 30.
    runs = [
        made_up(tmp_path / "a", scores=[0.1, 0.2, 0.3, 0.4]),
        made_up(tmp_path / "b", scores=[0.5, 0.5, 0.5], every=15),
    ]
    mean = learning_curves(runs, x="time", smooth=1)["groups"]["gae"]["mean"]
    assert mean["x"] == [15, 30]
    assert mean["y"] == pytest.approx([(0.15 + 0.5) / 2, (0.3 + 0.5) / 2])


def test_runs_are_grouped_by_any_key_of_their_configuration(tmp_path: Path):
    runs = [made_up(tmp_path / str(r), "view=local", f"view.reach={r}", scores=[0.5]) for r in (1, 2)]
    assert list(learning_curves(runs, by="view.reach")["groups"]) == ["1", "2"]


def test_validation_has_points_where_a_run_was_validated_and_is_not_smoothed(tmp_path: Path):
    run = made_up(tmp_path, scores=[0.1, 0.2, 0.3, 0.4])
    found = learning_curves([run], x="seconds", measure="validation")
    assert found["smooth"] == 1
    assert found["groups"]["gae"]["runs"][0]["x"] == [20, 40]
    assert found["groups"]["gae"]["runs"][0]["y"] == [0.2, 0.4]


def test_a_smoothed_point_is_the_mean_of_the_last_ones():
    assert trailing_mean(np.array([1.0, 3.0, 5.0, 10.0]), 3) == pytest.approx([1.0, 2.0, 3.0, 6.0])
    assert trailing_mean(np.array([1.0, 3.0]), 1).tolist() == [1.0, 3.0]


def test_a_picture_has_a_thin_line_for_each_run_and_a_thick_one_for_each_group(tmp_path: Path):
    runs = [made_up(tmp_path / str(seed), f"seed={seed}", scores=[0.1, 0.2]) for seed in range(2)]
    runs.append(made_up(tmp_path / "c", "algorithm=ippo", scores=[0.3, 0.4]))
    axes = curves_by_group(learning_curves(runs)).axes[0]
    assert [line.get_linewidth() > 2 for line in axes.lines] == [False, False, True, False, True]
    assert len({line.get_color() for line in axes.lines}) == 2
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["gae, mean of 2 runs", "ippo, mean of 1 run"]


def test_the_command_writes_the_picture_and_its_numbers(tmp_path: Path):
    run = made_up(tmp_path / "run", scores=[0.1, 0.2])
    assert run_command(["curves", str(run), "--out", str(tmp_path / "curves.png"), "--x", "time"]) == 0
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert read_json(tmp_path / "curves.json") == learning_curves([run], x="time")


def test_what_cannot_be_drawn_is_refused_by_name(tmp_path: Path):
    run = made_up(tmp_path / "run", scores=[0.1])
    with pytest.raises(InvalidFileError, match="nowhere"):
        learning_curves([tmp_path / "nowhere"])
    with pytest.raises(InvalidOptionError, match=r"by: .* got 'algorithm.nothing'"):
        learning_curves([run], by="algorithm.nothing")
    with pytest.raises(InvalidFileError, match="a value of 'validation'"):
        learning_curves([run], measure="validation")
    with pytest.raises(UnknownNameError, match="x-axis"):
        learning_curves([run], x="days")
    assert run_command(["curves", str(run), "--out", str(tmp_path / "curves.json")]) == 2

"""A domain of another distribution goes through every command; nothing in the package knows it."""

import csv
import json
import sys

import numpy as np
import pytest

FEW = ("--instances", 2, "--episodes", 1)
TINY = (
    "env=couriers-deployable", "view=near", "view.reach=2", "algorithm=gae", "algorithm.instances=4",
    "algorithm.turns=20", "validation.instances=2", "validation.every=1", "save_every=1",
)  # fmt: skip


def test_without_the_distribution_its_domain_is_unknown():
    from marl_sched.domain import domain_names

    assert not {"couriers", "couriers-deployable"} & set(domain_names())


def test_list_names_it_with_its_own_unit_options_and_the_scheduler_of_another_group(run):
    said = run("list").out
    assert "couriers: couriers serve jobs that arrive day by day" in said
    assert "views        full, near(reach=3)" in said
    assert "options      days=12, delay=0.25" in said
    assert "schedulers   nearest, idle, oldest-first" in said


def test_listing_names_imports_nothing_of_it(installed):
    from marl_sched.domain import domain_names

    assert domain_names()[-2:] == ["couriers", "couriers-deployable"]
    assert "couriers" not in sys.modules


def test_generated_problems_are_evaluated_from_their_files(run, tmp_path):
    assert run("generate", "couriers", "--scale", "city", "--count", 2, "--out", tmp_path).code == 0
    ended = run(
        "evaluate", "--env", "couriers", "--schedulers", "nearest,oldest-first", "--scheduler",
        "couriers.schedulers:Idle", "--instances", tmp_path, "--episodes", 2, "--view", "near", "--reach", 2, "--days",
        9, "--delay", 0.5, "--json", tmp_path / "r" / "results.json",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    assert "M1 is mean waiting over 9 days" in " ".join(ended.out.split())
    results = json.loads((tmp_path / "r" / "results.json").read_text())
    assert (results["horizon"], results["unit"], results["better"]) == (9, "days", "lower")
    assert results["view"]["kind"] == "near"
    assert results["options"] == {"delay": 0.5}
    rows = results["schedulers"]
    assert list(rows) == ["nearest", "oldest-first", "couriers.schedulers:Idle"]
    # Fewer waiting jobs than nobody's work leaves are a gain, although the score is lower.
    assert rows["nearest"]["M1"]["mean"] < rows["couriers.schedulers:Idle"]["M1"]["mean"]
    assert rows["nearest"]["M2"]["mean"] > 0


def test_an_option_of_another_domain_is_refused_with_its_own(run):
    ended = run("evaluate", "--env", "couriers", "--schedulers", "idle", *FEW, "--hours", 4)
    assert ended.code == 2
    assert "unknown option of couriers with view full '--hours'" in ended.err
    assert "--days" in ended.err


def test_a_comparison_is_drawn(run, tmp_path):
    ended = run("compare", "--env", "couriers", "--schedulers", "nearest,idle", *FEW, "--out", tmp_path)
    assert ended.code == 0, ended.err
    assert {"results.json", "scores.png", "timelines.png"} <= {path.name for path in tmp_path.iterdir()}


def test_it_cannot_be_deployed_without_telemetry(run):
    ended = run("deploy", "--env", "couriers", "--policy", "nearest")
    assert (ended.code, "couriers has no telemetry" in ended.err) == (2, True)


def test_it_has_no_bound_no_tables_and_no_demonstration_and_says_so(run):
    for command in ("bound", "tables", "demo"):
        ended = run(command, "--env", "couriers")
        assert (ended.code, "'couriers'" in ended.err) == (2, True), ended.err


@pytest.mark.slow
def test_it_is_trained_resumed_exported_drawn_and_deployed(run, tmp_path):
    """Two updates in one go, and one, then one more, are the same run; its policy plays as processes."""
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    assert run("train", *TINY, "updates=2", f"run_dir={whole}").code == 0
    assert run("train", *TINY, "updates=1", f"run_dir={halves}").code == 0
    record = json.loads((halves / "config.json").read_text())
    record["config"]["updates"] = 2
    (halves / "config.json").write_text(json.dumps(record))
    assert run("resume", halves).code == 0
    logs = [list(csv.DictReader((folder / "progress.csv").open())) for folder in (whole, halves)]
    assert [row["reward_rate"] for row in logs[0]] == [row["reward_rate"] for row in logs[1]]
    assert (whole / "policy.safetensors").read_bytes() == (halves / "policy.safetensors").read_bytes()

    few = ("--instances", 1, "--episodes", 1)
    assert run("export", whole, "mine", "--out", tmp_path, *few).code == 0
    scores = json.loads((tmp_path / "mine.json").read_text())["scores"]
    assert {"town", "city"} <= set(scores)
    assert run("curves", whole, halves, "--x", "time", "--measure", "validation", "--out", tmp_path / "c.png").code == 0
    assert json.loads((tmp_path / "c.json").read_text())["unit"] == "days"

    policy = tmp_path / "mine.safetensors"
    ended = run(
        "deploy", "--env", "couriers-deployable", "--policy", policy, "--view", "near", "--reach", 2, "--seed", 3,
        "--delay", 0.9, "--json", tmp_path / "run.json",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    report = json.loads((tmp_path / "run.json").read_text())
    assert report["M1"] == _in_one_process(policy, seed=3, delay=0.9)


@pytest.mark.slow
def test_it_is_trained_by_workers_of_ray_and_the_log_says_how_fast(run, tmp_path):
    """With the parameters that they begin with, two workers play what one process does."""
    pytest.importorskip("ray")
    folders = {name: tmp_path / name for name in ("sync", "ray")}
    for name, folder in folders.items():
        ended = run("train", *TINY, "updates=2", f"collector={name}", "collector.workers=2", f"run_dir={folder}")
        assert ended.code == 0, ended.err
        assert f"turns collected by {name}" in ended.err
    logs = {name: list(csv.DictReader((folder / "progress.csv").open())) for name, folder in folders.items()}
    assert logs["ray"][0]["reward_rate"] == logs["sync"][0]["reward_rate"]
    assert all(float(row["frames_per_second"]) > 0 for rows in logs.values() for row in rows)


def _in_one_process(policy, seed, delay):
    from marl_sched.agents.playing import play
    from marl_sched.agents.registry import create_scheduler
    from marl_sched.problem import Problem

    view, options = {"kind": "near", "reach": 2}, {"delay": delay}
    problem = Problem("couriers-deployable", count=1, seed=seed, view=view, options=options)
    simulator = play(create_scheduler(policy, problem.domain), problem.simulator())
    return float(simulator.objectives()["waiting"][0])


@pytest.mark.slow
def test_it_is_measured(run, tmp_path):
    ended = run("bench", "--env", "couriers", "--repeats", 1, "--batch", 4, "--json", tmp_path / "bench.json")
    assert ended.code == 0, ended.err
    figures = json.loads((tmp_path / "bench.json").read_text())["figures"]
    assert {"policy_ms_town", "policy_ms_city"} < set(figures)


def test_it_is_rendered(installed):
    from marl_sched.envs.api.episode import SingleEpisode

    for mode, kind in (("ansi", str), ("rgb_array", np.ndarray)):
        episode = SingleEpisode("couriers", scale="town", render_mode=mode)
        episode.reset(1, None)
        assert isinstance(episode.render(), kind)

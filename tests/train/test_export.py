from __future__ import annotations

from pathlib import Path

import pytest

from marl_sched.agents.policies.cards import read_card
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.cli.app import run as run_command
from marl_sched.envs.airme.views import LocalView
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import evaluate_scheduler
from marl_sched.train.export import export_policy
from marl_sched.train.run import train_from_overrides

TINY = [
    "view=local", "policy.width=2", "policy.heads=2", "policy.layers=2", "algorithm.instances=4", "algorithm.turns=12",
    "updates=1", "validation.every=1", "validation.instances=1", "validation.length=10",
]  # fmt: skip


def test_the_card_holds_what_an_evaluation_with_that_seed_measures(tmp_path: Path):
    run = train_from_overrides([*TINY, f"run_dir={tmp_path / 'run'}"], quiet=True)
    card = export_policy(
        run, tmp_path / "mine.safetensors", scales=["small"], instances=2, episodes=2, seed=5, length=20
    )
    problem = Problem("airme", count=2, episodes=2, seed=5, view=LocalView(), objective="profit", horizon=20)
    policy = NetworkPolicy.load(tmp_path / "mine.safetensors")
    scores = evaluate_scheduler(problem, policy)
    assert card.scores["small"]["M1"] == pytest.approx(scores.measures["profit"].mean())
    assert card.scores["small"]["visible_share"] == pytest.approx(scores.visible_share)
    assert card.scores["validation"]["scale"] == "small"
    assert (card.scores["small"]["hours"], card.scores["validation"]["hours"]) == (20, 10)
    assert card.command == "marl-sched train " + " ".join(TINY)


def test_a_policy_is_measured_with_the_options_that_it_was_trained_with(tmp_path: Path):
    single = [*TINY, "+env.options.scheme=single"]
    run = train_from_overrides([*single, f"run_dir={tmp_path / 'run'}"], quiet=True)
    card = export_policy(run, tmp_path / "mine.safetensors", scales=["small"], instances=2, episodes=2, seed=5)
    problem = Problem("airme", count=2, episodes=2, seed=5, view=LocalView(), options={"scheme": "single"})
    policy = NetworkPolicy.load(tmp_path / "mine.safetensors")
    one, full = (
        evaluate_scheduler(played, policy).measures["profit"].mean() for played in (problem, problem.but(options={}))
    )
    assert one != pytest.approx(full)
    assert card.scores["small"]["M1"] == pytest.approx(one)
    assert card.scores["small"]["options"] == {"scheme": "single"}


def test_the_command_writes_a_policy_with_scores_of_every_scale(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = train_from_overrides([*TINY, f"run_dir={tmp_path / 'run'}"], quiet=True)
    few = ["--instances", "1", "--episodes", "1", "--length", "10", "--seed", "5"]
    assert run_command(["export", str(run), "mine", "--out", str(tmp_path / "out"), *few]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["mine.json", "mine.safetensors"]
    card = read_card(tmp_path / "out" / "mine.json")
    told = capsys.readouterr().out
    for scale in ("small", "medium", "large"):
        measured = card.scores[scale]
        assert (measured["instances"], measured["episodes"], measured["seed"]) == (1, 1, 5)
        assert f"{scale}: M1 {measured['M1']:.4f}" in told
    assert card.git_hash == read_card(run / "policy.json").git_hash
    assert NetworkPolicy.load(tmp_path / "out" / "mine.safetensors").name == "mine"


@pytest.mark.parametrize("name", ["a/b", "mine.json", "", ".."])
def test_the_command_refuses_what_is_no_name(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run_command(["export", str(tmp_path), name, "--out", str(tmp_path / "out")]) == 2
    assert "NAME: expected" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_command_refuses_a_folder_without_a_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run_command(["export", str(tmp_path), "mine", "--out", str(tmp_path / "out")]) == 2
    assert "policy.json" in capsys.readouterr().err

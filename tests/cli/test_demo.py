"""The demonstration, with a rule in the place of the shipped policy where that saves time."""

import json
from dataclasses import replace

import pytest

from marl_sched.agents.airme.schedulers import RULES
from marl_sched.cli import demo
from marl_sched.domain import get_domain
from marl_sched.errors import DeploymentError
from marl_sched.train.evaluation.compare import play_episode

AIRME = get_domain("airme")


def test_the_demo_has_seven_crews():
    assert demo.deployed_problem(AIRME, "condition").instances[0].n_crews == 7


def test_a_rule_plays_the_demo_with_the_local_view_as_it_comes():
    assert demo.deployed_problem(AIRME, "condition").view == AIRME.views["local"]()


@pytest.mark.parametrize("change", [lambda series: series[:-1], lambda series: [*series[:5], -1.0, *series[6:]]])
def test_a_deployed_episode_that_differs_from_the_one_in_one_process_is_an_error(change):
    problem = demo.deployed_problem(AIRME, "condition").but(horizon=12)
    replay = play_episode(problem, RULES["condition"]())
    series = AIRME.telemetry.series(replay)[problem.objective]
    demo.require_equal(series, problem, replay)
    different = change(series)
    with pytest.raises(DeploymentError, match=rf"time {11 if len(different) < 12 else 5} \(hours\)$"):
        demo.require_equal(different, problem, replay)


@pytest.mark.slow
def test_the_demo_deploys_compares_and_draws(run, tmp_path, monkeypatch):
    short = replace(AIRME, demo=replace(AIRME.demo, instances=2), default_horizon=48)
    monkeypatch.setattr("marl_sched.domain.get_domain", lambda name: short)
    ended = run("demo", "--policy", "preventive-first", "--out", tmp_path)
    assert ended.code == 0
    assert "the same to the last bit" in ended.out
    names = ["deployment.json", "results-full-view.json", "results-local-view.json", "scores.png", "timelines.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    deployed = json.loads((tmp_path / "deployment.json").read_text())
    assert len(deployed["agents"]) == 7
    assert deployed["time"] == len(deployed["profit"]) == 48
    assert deployed["deaths"] == []
    assert deployed["view"]["visible_share"] <= 0.45
    local = json.loads((tmp_path / "results-local-view.json").read_text())
    assert list(local["schedulers"]) == ["preventive-first", "condition"]

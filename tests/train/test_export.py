from __future__ import annotations

from pathlib import Path

import pytest

from marl_sched.agents.hetgat.policy import HetGATPolicy
from marl_sched.domain import get_domain
from marl_sched.envs.airme.views import LocalView
from marl_sched.train.evaluate import Settings, evaluate_scheduler
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
    settings = Settings(episodes=2, seed=5, view=LocalView(), objective="profit", horizon=20, scale="small")
    domain = get_domain("airme")
    policy = HetGATPolicy.load(tmp_path / "mine.safetensors")
    scores = evaluate_scheduler(domain, policy, domain.instances("small", 2, 5), settings)
    assert card.scores["small"]["M1"] == pytest.approx(scores.measures["profit"].mean())
    assert card.scores["small"]["visible_share"] == pytest.approx(scores.visible_share)
    assert card.scores["validation"]["scale"] == "small"
    assert card.command == "marl-sched train " + " ".join(TINY)

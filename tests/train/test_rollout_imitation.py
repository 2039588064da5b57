"""Imitation of roll-outs: labels by hand, and teachers that cannot teach."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from marl_sched.errors import InvalidOptionError
from marl_sched.train.algorithms.rollout_imitation import excess_costs
from marl_sched.train.run import train_from_overrides

TINY = [
    "env=murse", "policy=hetgat_residual", "algorithm=rollout_imitation", "curriculum=rounds", "env.scales=[small]",
    "policy.width=4", "policy.heads=2", "policy.hidden=16", "algorithm.instances=8", "algorithm.turns=8",
    "validation.every=4", "validation.instances=2", "validation.length=1", "save_every=2", "threads=1",
]  # fmt: skip


def test_excess_costs_are_shares_above_the_least():
    costs = torch.tensor([[110.0, 100.0, torch.inf], [torch.inf, torch.inf, torch.inf]], dtype=torch.float64)
    excess = excess_costs(costs)
    torch.testing.assert_close(excess, torch.tensor([[0.1, 0.0, torch.inf], [0.0, torch.inf, torch.inf]]))


def test_teacher_that_tells_no_costs_is_refused(tmp_path: Path):
    with pytest.raises(InvalidOptionError, match="works out what every choice costs, got lst"):
        train_from_overrides([*TINY, "updates=1", "algorithm.teacher=lst", f"run_dir={tmp_path}/run"], quiet=True)

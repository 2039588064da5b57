"""Small training tasks and rollouts for tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.problem import Problem
from marl_sched.train.collect import Rollout, SegmentCollector
from marl_sched.train.curriculum import EpisodeLength
from marl_sched.train.environment import TrainingTask

LOCAL = {"kind": "local", "reach": 1, "comm": 1, "staleness": 0}


def fixed(length: int) -> EpisodeLength:
    return EpisodeLength(start=length, step=0.0, stop=length, spread=0, seed=0)


def task(
    *,
    rows: int = 4,
    length: int = 8,
    turns: int | None = 30,
    view: Mapping[str, Any] = LOCAL,
    options: Mapping[str, Any] | None = None,
    **of_task: Any,
) -> TrainingTask:
    problem = Problem(
        "airme",
        scale="small",
        objective="profit",
        view=view,
        seed=3,
        split="train",
        horizon=2 * length,
        options=options,
    )
    return TrainingTask(problem=problem, scales=["small"], rows=rows, length=fixed(length), turns=turns, **of_task)


def segment(policy: HetGATNetwork, **options: Any) -> Rollout:
    playing = task(central=True, **options)
    return SegmentCollector(playing).collect(policy, playing.length(0))


def changed(rollout: Rollout, where: torch.Tensor, value: float, *names: Any) -> Rollout:
    """A rollout with another value in entries of its turns `where`, bool (T, B)."""
    data = rollout.data.clone()
    for name in names:
        entry = data[name]
        data[name] = torch.where(where.T.view(*where.T.shape, *[1] * (entry.dim() - 2)), value, entry)
    return replace(rollout, data=data)

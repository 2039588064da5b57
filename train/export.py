"""Keeping a run's best policy as the two files that everything else loads."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from marl_sched.agents.cards import PolicyCard, Sizes, source_revision
from marl_sched.agents.hetgat.checkpoint import save_network
from marl_sched.agents.hetgat.network import HetGATNetwork
from marl_sched.train.config import GaeConfig, TrainConfig

BEST = "policy.safetensors"


def save_best(
    network: HetGATNetwork, config: TrainConfig, update: int, score: float, directory: Path, overrides: Sequence[str]
) -> None:
    """Write `policy.safetensors` and its card into the run's directory; `score` is M1 on the validation set."""
    validation = config.validation
    measured = {
        "M1": score,
        "instances": validation.instances,
        "episodes": validation.episodes,
        "seed": validation.seed,
    }
    central = isinstance(config.algorithm, GaeConfig) and config.view["kind"] != "full"
    card = PolicyCard(
        domain=config.env.name,
        objective=config.env.objective,
        view=config.view,
        graph=network.spec,
        sizes=Sizes(**network.sizes),
        command=shlex.join(["marl-sched", "train", *(o for o in overrides if not o.startswith("run_dir="))]),
        git_hash=source_revision(),
        seed=config.seed,
        scores={"validation": {"scale": config.env.scales[0], "update": update, **measured}},
        training_knowledge="a critic on the full graph" if central else "",
    )
    save_network(directory / BEST, network, card)

"""Keeping a run's best policy as the two files that everything else loads."""

from __future__ import annotations

from pathlib import Path

from marl_sched.agents.cards import PolicyCard, Sizes
from marl_sched.agents.hetgat.checkpoint import save_network
from marl_sched.agents.hetgat.network import HetGATNetwork
from marl_sched.train.config import GaeConfig, RunRecord

BEST = "policy.safetensors"


def save_best(network: HetGATNetwork, record: RunRecord, update: int, score: float, directory: Path) -> None:
    """Write `policy.safetensors` and its card into the run's directory; `score` is M1 on the validation set."""
    config = record.config
    validation = config.validation
    central = isinstance(config.algorithm, GaeConfig) and config.view["kind"] != "full"
    measured = {
        "scale": config.env.scales[0],
        "M1": score,
        "instances": validation.instances,
        "episodes": validation.episodes,
        "seed": validation.seed,
        "update": update,
    }
    card = PolicyCard(
        domain=config.env.name,
        objective=config.env.objective,
        view=config.view,
        graph=network.spec,
        sizes=Sizes(**network.sizes),
        command=record.command,
        git_hash=record.revision,
        seed=config.seed,
        scores={"validation": measured},
        training_knowledge="a critic on the full graph" if central else "",
    )
    save_network(directory / BEST, network, card)

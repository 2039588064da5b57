"""Keeping a run's best policy as the two files that everything else loads, and measuring it for its card."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from marl_sched.agents.networks.network import PolicyNetwork, slots_of
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.agents.policies.checkpoint import load_network, save_network
from marl_sched.agents.policies.network_policy import policy_of
from marl_sched.domain import Domain, get_domain
from marl_sched.problem import Problem
from marl_sched.train.config import RunRecord, load_record
from marl_sched.train.evaluation.evaluate import evaluate_scheduler

CONFIG, BEST = "config.json", "policy.safetensors"  # in a run's directory


def save_best(
    network: PolicyNetwork, record: RunRecord, update: int, means: Mapping[str, float], directory: Path
) -> None:
    """Write `policy.safetensors` and its card into the run's directory; `means` is M1 on each validation set."""
    config = record.config
    validation = config.validation
    domain = get_domain(config.env.name)
    measured = {
        "scale": ", ".join(means),
        "M1": next(iter(means.values())) if len(means) == 1 else dict(means),
        "instances": validation.instances,
        "episodes": validation.episodes,
        "seed": validation.seed,
        domain.unit: validation.length or domain.default_horizon,
        "update": update,
    }
    card = PolicyCard(
        domain=config.env.name,
        objective=config.env.objective,
        view=config.view,
        graph=network.spec,
        sizes=network.sizes,
        command=record.command,
        git_hash=record.source,
        seed=config.seed,
        scores={"validation": measured},
        training_knowledge=knowledge(record),
        mode=validation.mode,
    )
    save_network(directory / BEST, network, card)


def knowledge(record: RunRecord) -> str:
    """What a run uses beyond the policy's view, the runs that it goes on from included."""
    config = record.config
    before = record.start.knowledge if record.start is not None else ""
    used = re.split(r", (?![^()]*\))", before) if before else []  # a teacher's knowledge has commas in brackets
    used += config.algorithm.knowledge(config)
    return ", ".join(dict.fromkeys(used))


def export_policy(
    run_dir: Path,
    path: Path,
    *,
    scales: Sequence[str] | None = None,
    instances: int = 100,
    episodes: int = 10,
    seed: int = 1,
    length: int | None = None,
) -> PolicyCard:
    """Measure a run's best policy on unseen instances of each scale, and write it with those scores to `path`.

    `scales` None: all of the domain's whose padded sizes its network can read. Instances and noise are those of
    `marl-sched evaluate --seed SEED`, the simulator's further options those of the run; `length` is the simulated time
    of an episode, None: the environment's. Returns the card as written. Raises UnknownNameError for an unknown scale.
    """
    network, card = load_network(run_dir / BEST)
    options = load_record(run_dir / CONFIG).config.env.options
    domain = get_domain(card.domain)
    view = domain.make_view(card.view)
    measured = {}
    for scale in _readable(network, domain) if scales is None else scales:
        problem = Problem(
            domain,
            scale=scale,
            count=instances,
            episodes=episodes,
            seed=seed,
            view=view,
            objective=card.objective,
            horizon=length,
            options=options,
        )
        policy = policy_of(network, mode=card.mode, card=card)
        scores = evaluate_scheduler(problem, policy)
        means = scores.measures[card.objective].mean(axis=1)
        measured[scale] = {
            "M1": float(means.mean()),
            "std": float(means.std()),
            **({"feasible": float(scores.measures["feasible"].mean())} if "feasible" in scores.measures else {}),
            "visible_share": scores.visible_share,
            "options": options,
            "instances": instances,
            "episodes": episodes,
            "seed": seed,
            domain.unit: length or domain.default_horizon,
        }
    save_network(path, network, msgspec.structs.replace(card, scores={**card.scores, **measured}))
    return load_network(path)[1]


def _readable(network: PolicyNetwork, domain: Domain) -> list[str]:
    """The domain's scales whose observations a network can read."""
    readable = []
    for scale in domain.scales:
        simulator = domain.simulator(domain.instances(scale, 1, 0), pad=scale)
        if network.reads(slots_of(simulator.graph, simulator.arrays)):
            readable.append(scale)
    return readable

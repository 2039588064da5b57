"""A cell of the tables: one scheduler on all instances of a scale, known by the hash of its inputs.

The hash covers what is played and whoever plays (the weights' SHA-256, if it is a policy). Beside it a cell holds the
digest of the kernels that it was made with, see `marl_sched.train.published.store`. `SCHEMA` counts the changes of
rules, bounds, networks and this format that make old cells void.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from marl_sched.agents.policies.cards import read_card, source_revision
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.kernel_sources import sources_digest
from marl_sched.privileged import PrivilegedInfo
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import evaluate_scheduler

SCHEMA = 1
DECIMALS = 6


class Play(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="play"):
    """Inputs of a cell that is played: whose scores, on what, how often.

    `view` is as JSON, with all its options. `mode` is a policy's, by its card; a rule has none, and no weights.
    """

    env: str
    scale: str
    objective: str
    scheduler: str
    weights_sha256: str | None
    mode: str | None
    view: dict[str, Any]
    options: dict[str, Any]
    instances: int
    episodes: int
    seed: int
    horizon: int
    schema: int = SCHEMA

    def problem(self) -> Problem:
        """What is played; its defaults are none, so that a cell keeps its name when they change."""
        return Problem(
            self.env,
            scale=self.scale,
            count=self.instances,
            episodes=self.episodes,
            seed=self.seed,
            view=self.view,
            objective=self.objective,
            horizon=self.horizon,
            options=self.options,
        )


class Bound(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="bound"):
    """Inputs of a cell that is proved: what no scheduler's expected M1 passes on each instance."""

    env: str
    scale: str
    objective: str
    instances: int
    seed: int
    horizon: int
    price_vectors: int
    evaluations: int
    schema: int = SCHEMA

    def problem(self) -> Problem:
        """What is bounded."""
        return Problem(
            self.env,
            scale=self.scale,
            count=self.instances,
            seed=self.seed,
            objective=self.objective,
            horizon=self.horizon,
        )


Inputs = Play | Bound


class Training(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a learned scheduler's card says of its making."""

    command: str
    seed: int
    view: dict[str, Any]
    knowledge: str


class Cell(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A finished cell.

    Attributes:
        inputs: what it was made of.
        M1: each instance's mean over its episodes, or its bound.
        episode_std: root of the mean over instances of the variance between an instance's episodes.
        visible_share: share of the graph that acting agents saw.
        privileged_info: what the scheduler uses beyond what its agents see, by the names of PrivilegedInfo.
        training: of a learned scheduler.
        seconds: that it took.
        revision: of the source that made it.
        kernels: digest of the kernels that it was made or confirmed with; None: it is older than these digests.
    """

    inputs: Inputs
    M1: list[float]
    episode_std: float | None = None
    visible_share: float | None = None
    privileged_info: list[str] = []
    training: Training | None = None
    seconds: float
    revision: str
    kernels: str | None = None

    @property
    def knows(self) -> PrivilegedInfo:
        """`privileged_info` as the flag."""
        return PrivilegedInfo.of(self.privileged_info)


@dataclass(frozen=True)
class Job:
    """A cell to be made; `weights` is where those of a policy are.

    `besides` are cells that the same episodes give: those of a rule that does not heed the objective, for others.
    """

    inputs: Inputs
    weights: Path | None = None
    besides: tuple[Play, ...] = ()

    @property
    def cost(self) -> float:
        """About how long it takes compared to other jobs: measured on a core, in thousandths of a second."""
        inputs, domain = self.inputs, get_domain(self.inputs.env)
        size = 2.5 ** list(domain.scales).index(inputs.scale)  # nodes double, agents double
        if isinstance(inputs, Bound):
            return 5000.0 * inputs.price_vectors * inputs.evaluations * inputs.horizon / domain.default_horizon
        rows = inputs.instances * inputs.episodes * inputs.horizon / domain.default_horizon
        return rows * size * (10.0 if self.weights is None else 60.0)


def describe(inputs: Inputs) -> str:
    """A cell in words, for people who wait for it: `condition, medium, profit, view local reach 1, ...`."""
    if isinstance(inputs, Bound):
        return f"the bound, {inputs.scale}, {inputs.objective}"
    view = ", ".join(f"{name} {value}" for name, value in inputs.view.items() if name != "kind")
    details = [f"view {inputs.view['kind']} {view}".strip(), *(f"{k} {v}" for k, v in inputs.options.items())]
    return f"{inputs.scheduler}, {inputs.scale}, {inputs.objective}, {', '.join(details)}"


def digest(inputs: Inputs) -> str:
    """The name of a cell: 16 hexadecimal digits of the SHA-256 of its inputs as canonical JSON."""
    return hashlib.sha256(msgspec.json.encode(inputs, order="sorted")).hexdigest()[:16]


def weights_sha256(path: Path) -> str:
    """SHA-256 of a policy's weights file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def make(job: Job) -> list[Cell]:
    """Play or prove a job's cell, and those besides."""
    if isinstance(job.inputs, Bound):
        return [_prove(job.inputs)]
    return _play(job.inputs, job.weights, job.besides)


def _play(inputs: Play, weights: Path | None, besides: Sequence[Play]) -> list[Cell]:
    domain = get_domain(inputs.env)
    training = None
    if weights is not None:
        if weights_sha256(weights) != inputs.weights_sha256:
            raise InvalidFileError(weights, "", "the weights that were there when the cells were listed")
        card = read_card(weights.with_suffix(".json"))
        training = Training(command=card.command, seed=card.seed, view=card.view, knowledge=card.training_knowledge)
    scheduler = (
        create_scheduler(inputs.scheduler, domain)
        if weights is None
        else create_scheduler(weights, domain, mode=inputs.mode)
    )
    scores = evaluate_scheduler(inputs.problem(), scheduler)
    revision = source_revision()
    return [
        Cell(
            inputs=wanted,
            M1=_rounded(m1.mean(axis=1)),
            episode_std=round(float(np.sqrt(m1.var(axis=1).mean())), DECIMALS),
            visible_share=round(scores.visible_share, DECIMALS),
            privileged_info=scores.privileged_info.names,
            training=training,
            seconds=round(scores.seconds, 1),
            revision=revision,
            kernels=kernels_of(inputs.env),
        )
        for wanted in (inputs, *besides)
        for m1 in (scores.measures[wanted.objective],)
    ]


def _prove(inputs: Bound) -> Cell:
    started = time.perf_counter()
    domain = get_domain(inputs.env)
    if domain.bound is None:
        raise InvalidOptionError(f"env: no bound is known for the environment {inputs.env!r}")
    bounds = import_module(domain.bound)
    problem = inputs.problem()
    relaxation = bounds.Relaxation(problem.instances, objective=problem.objective, horizon=problem.horizon)
    found = bounds.upper_bounds(relaxation, price_vectors=inputs.price_vectors, evaluations=inputs.evaluations)
    return Cell(
        inputs=inputs,
        M1=_rounded(found.value, up=True),
        privileged_info=domain.bound_info.names,
        seconds=round(time.perf_counter() - started, 1),
        revision=source_revision(),
        kernels=kernels_of(inputs.env),
    )


@cache
def kernels_of(env: str) -> str:
    """The digest of what a domain's simulator and rules are made from (marl_sched.kernel_sources)."""
    domain = get_domain(env)
    rules = domain.schedulers.partition(":")[0] if isinstance(domain.schedulers, str) else domain.simulator.__module__
    return sources_digest(domain.simulator.__module__, rules)


def _rounded(values: np.ndarray, *, up: bool = False) -> list[float]:
    """To six decimals; a bound is rounded up, to stay one."""
    scale = 10**DECIMALS
    return [float(v) for v in np.round((np.ceil if up else np.rint)(values * scale) / scale, DECIMALS)]

"""From the list of tables to the cells they need: who plays what, and whose policy is not there yet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from marl_sched.agents.policies.cards import Mode, read_card
from marl_sched.agents.registry import SHIPPED, rules
from marl_sched.problem import view_as_json
from marl_sched.train.published.cells import Bound, Job, Play, digest, weights_sha256
from marl_sched.train.published.plan import Line, Plan, Player, Row, Size


@dataclass(frozen=True)
class Untrained:
    """A policy that an entry needs and that is not there; `command` trains it, "" where the list does not say."""

    label: str
    policy: str
    command: str


class Entries:
    """The entries of a plan at one size: each a job, or what is missing for one.

    Paths of policies are relative to `root`; policies that ship with the package are found by name.
    """

    def __init__(self, plan: Plan, size: Size, root: Path) -> None:
        self.plan, self.size, self.root = plan, size, root
        self._hashes: dict[Path, str] = {}

    def row(self, row: Row, objective: str, scale: str) -> Job | Untrained | None:
        """A row's entry; None if it has none for this objective and scale."""
        if not row.plays(objective, scale):
            return None
        fewer = row.episodes.get(scale)
        return self._entry(row, row.policy, objective, scale, row.view, row.options, fewer, row.mode)

    def point(self, line: Line, view: str, scale: str) -> Job | Untrained | None:
        """A line's entry under a view by name; None if it has none."""
        section = self.plan.decentralisation
        policy = line.policies.get(view) if line.policies else line.policy
        if line.rule is None and policy is None:
            return None
        return self._entry(line, policy, section.objective, scale, section.views[view], {}, section.episodes)

    def bound(self, objective: str, scale: str) -> Job:
        """The upper bound on a scale."""
        plan, size = self.plan, self.size
        inputs = Bound(
            env=plan.env,
            scale=scale,
            objective=objective,
            instances=size.instances,
            seed=plan.seed,
            horizon=self.horizon,
            price_vectors=size.bound.price_vectors,
            evaluations=size.bound.evaluations,
        )
        return Job(inputs)

    def all(self) -> tuple[list[Job], list[Untrained]]:
        """Every job once, cheapest first, and every policy that is not there once."""
        jobs: dict[str, Job] = {}
        untrained: dict[str, Untrained] = {}
        for entry in self._every():
            if isinstance(entry, Untrained):
                known = untrained.setdefault(entry.policy, entry)
                if entry.command and not known.command:
                    untrained[entry.policy] = entry
            elif entry is not None:
                jobs[digest(entry.inputs)] = entry
        return sorted(self._together(jobs.values()), key=lambda job: job.cost), list(untrained.values())

    def _together(self, jobs: Iterable[Job]) -> list[Job]:
        """Jobs with those of a rule that does not heed the objective made one."""
        together: dict[str, Job] = {}
        for job in jobs:
            inputs = job.inputs
            name = digest(inputs)
            if isinstance(inputs, Play) and job.weights is None and not self._heeds(inputs.scheduler):
                name = digest(msgspec.structs.replace(inputs, objective=""))
                if name in together:
                    job = replace(together[name], besides=(*together[name].besides, inputs))
            together[name] = job
        return list(together.values())

    def _heeds(self, rule: str) -> bool:
        return rules(self.plan.env)[rule]().heeds_objective

    @property
    def horizon(self) -> int:
        """Simulated time of an episode."""
        return self.plan.horizon or self.plan.domain.default_horizon

    def _every(self) -> Iterator[Job | Untrained | None]:
        for objective in self.plan.objectives:
            for scale in self.plan.scales:
                yield self.bound(objective, scale)
                for row in self.plan.rows:
                    yield self.row(row, objective, scale)
        section = self.plan.decentralisation
        for scale in section.scales:
            for line in section.lines:
                for view in section.views:
                    yield self.point(line, view, scale)

    def _entry(
        self,
        player: Player,
        policy: str | None,
        objective: str,
        scale: str,
        view: Mapping[str, Any],
        options: Mapping[str, Any],
        fewer: int | None,
        mode: Mode | None = None,
    ) -> Job | Untrained:
        weights = None
        name = player.rule or ""
        if policy is not None:
            name = _filled(policy, objective, scale)
            weights = self.root / name if "/" in name else SHIPPED / f"{name}.safetensors"
            if not weights.exists():
                return Untrained(player.label, name, _filled(player.command, objective, scale))
        inputs = Play(
            env=self.plan.env,
            scale=scale,
            objective=objective,
            scheduler=name,
            weights_sha256=None if weights is None else self._hash(weights),
            mode=None if weights is None else mode or read_card(weights.with_suffix(".json")).mode,
            view=view_as_json(self.plan.domain.make_view(dict(view))),
            options=dict(options),
            instances=self.size.instances,
            episodes=min(self.size.episodes, fewer or self.size.episodes),
            seed=self.plan.seed,
            horizon=self.horizon,
        )
        return Job(inputs, weights)

    def _hash(self, weights: Path) -> str:
        if weights not in self._hashes:
            self._hashes[weights] = weights_sha256(weights)
        return self._hashes[weights]


def _filled(text: str, objective: str, scale: str) -> str:
    return text.replace("{objective}", objective).replace("{scale}", scale)

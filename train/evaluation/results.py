"""What an evaluation found, as values: what tables are printed from, pictures drawn from and files written from.

`Results.as_json` is schema 2 of `marl-sched evaluate --json`. What was not measured, or makes no sense for a domain or
a scheduler, is None here; a file does not have it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct, structs, to_builtins

from marl_sched.privileged import PrivilegedInfo
from marl_sched.problem import Problem, view_as_json
from marl_sched.statistics import PairedDifference, Summary

SCHEMA = 2  # 1 named the horizon by its unit, as `hours`
LOCAL_SHARE = 0.45  # a view that shows more of the graph than this is not called local


class Measure(Struct, frozen=True, kw_only=True):
    """What a domain or a scheduler measures beside M1.

    Attributes:
        mean: over all that was measured, None if nothing was.
        summary: its statistics over instances and episodes, where it is told by episode.
        per_round: means by round, where it is told by round; None for a round in which nothing was measured.
    """

    mean: float | None
    summary: Summary | None = None
    per_round: list[float | None] | None = None

    def as_json(self) -> dict[str, Any]:
        """The mean, then the summary's figures, then the rounds'."""
        by_round = {} if self.per_round is None else {"per_round": self.per_round}
        return {"mean": self.mean, **({} if self.summary is None else self.summary.as_json()), **by_round}


class Gap(Struct, frozen=True, kw_only=True):
    """How far a scheduler is from another's scores or bounds, in percent, over rounds that both could do.

    `mean` and `std` are None where there is no such round.
    """

    mean: float | None
    std: float | None
    rounds: int


class AgentFigure(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A figure of single agents: its mean, and the means over episodes of the least and the greatest agent."""

    mean: float
    least: float | None = None
    greatest: float | None = None


class AgentsSummary(Struct, frozen=True, kw_only=True):
    """What single agents did.

    Attributes:
        figures: by name; `fairness` is that of the utilisation and has a mean alone.
        by_agent: each agent's means, where there is one instance only.
    """

    figures: dict[str, AgentFigure]
    by_agent: dict[str, dict[str, float]] | None = None

    def as_json(self) -> dict[str, Any]:
        """The figures, and those of single agents under `by_agent`."""
        alone = {} if self.by_agent is None else {"by_agent": self.by_agent}
        return {**to_builtins(self.figures), **alone}


class InstanceScores(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A scheduler on one instance.

    Attributes:
        objective: mean over its episodes.
        feasible: share of feasible rounds, in a domain that has infeasible ones.
        status: of all rounds of a solver: "optimal" if all were proved, "no plan" if one had no feasible plan, else
            "feasible".
        bound, gap_to_bound: a solver's, the gap in percent.
        timed_out: a solver's runs that a limit ended.
        seconds: a solver's, per round.
    """

    objective: float
    feasible: float | None = None
    status: str | None = None
    bound: float | None = None
    gap_to_bound: float | None = None
    timed_out: int | None = None
    seconds: float | None = None


class InstanceRow(Struct, frozen=True, kw_only=True):
    """One instance: its number, its file where it came from one, and every scheduler's scores."""

    instance: int
    file: str | None
    schedulers: dict[str, InstanceScores]


class SchedulerResults(Struct, frozen=True, kw_only=True):
    """What one scheduler reached.

    Attributes:
        M1: of the problem's objective.
        scores: M1 of every episode, a list for each instance: two runs on the same instances with the same seed are
            paired episode by episode.
        M2: gain over the reference in percent, positive for a gain; None without a reference.
        measures: all the domain and the scheduler measured, the objective among them.
        gap_to_exact, gap_to_bound: where the exact scheduler plays, and where it proved bounds.
        difference: paired, to the table's baseline.
        visible_share: share of the graph that acting agents saw, mean over turns.
        privileged_info: what it uses beyond that.
        agents: what single agents did, where the domain counts it.
        seconds: wall time of all episodes.
    """

    M1: Summary
    scores: list[list[float]]
    M2: Summary | None = None
    measures: dict[str, Measure]
    gap_to_exact: Gap | None = None
    gap_to_bound: Gap | None = None
    difference: PairedDifference
    visible_share: float
    privileged_info: PrivilegedInfo
    agents: AgentsSummary | None = None
    seconds: float

    @property
    def local(self) -> bool:
        """Whether it saw little enough to be called local."""
        return self.visible_share <= LOCAL_SHARE

    @property
    def figures(self) -> dict[str, Measure | Gap]:
        """All that is told beside M1, M2 and the difference, by name."""
        gaps = {"gap_to_exact": self.gap_to_exact, "gap_to_bound": self.gap_to_bound}
        return {**self.measures, **{name: gap for name, gap in gaps.items() if gap is not None}}

    def as_json(self, baseline: str) -> dict[str, Any]:
        """A row of the file; `baseline` is what the difference is to."""
        row: dict[str, Any] = {"M1": self.M1.as_json(), "scores": self.scores}
        if self.M2 is not None:
            row["M2"] = self.M2.as_json()
        row |= {
            name: one.as_json() if isinstance(one, Measure) else to_builtins(one) for name, one in self.figures.items()
        }
        if self.agents is not None:
            row["agents"] = self.agents.as_json()
        return row | {
            "difference": {"to": baseline, **self.difference.as_json()},
            "visible_share": self.visible_share,
            "local": self.local,
            "privileged_info": self.privileged_info.names,
            "seconds": self.seconds,
        }


class Reference(Struct, frozen=True, kw_only=True):
    """What M2 is the gain over: a scheduler under the full view."""

    scheduler: str
    M1: Summary


class Baseline(Struct, frozen=True, kw_only=True):
    """What paired differences are taken to: a scheduler under a view, as JSON."""

    scheduler: str
    view: dict[str, Any]


class Results(Struct, frozen=True, kw_only=True):
    """Schedulers side by side.

    Attributes:
        problem: what was played.
        schedulers: by the name that was typed.
        reference: None for a domain without one.
        by_instance: a row for each instance.
    """

    problem: Problem
    baseline: Baseline
    reference: Reference | None = None
    schedulers: dict[str, SchedulerResults]
    by_instance: list[InstanceRow]

    @property
    def visible_share(self) -> float:
        """Share of the graph that acting agents saw, mean over the schedulers."""
        return sum(one.visible_share for one in self.schedulers.values()) / len(self.schedulers)

    @property
    def local(self) -> bool:
        """Whether the view showed little enough to be called local."""
        return self.visible_share <= LOCAL_SHARE

    @property
    def best_first(self) -> list[tuple[str, SchedulerResults]]:
        """The schedulers by their mean M1."""
        higher = self.problem.domain.better == "higher"
        return sorted(self.schedulers.items(), key=lambda item: item[1].M1.mean, reverse=higher)

    def as_json(self) -> dict[str, Any]:
        """Schema 2 of `marl-sched evaluate --json`."""
        problem = self.problem
        data: dict[str, Any] = {
            "schema": SCHEMA,
            "env": problem.domain.name,
            "scale": problem.pad,
            "objective": problem.objective,
            "better": problem.domain.better,
            "view": {**view_as_json(problem.view), "visible_share": self.visible_share, "local": self.local},
            "instances": problem.count,
            "episodes": problem.episodes,
            "horizon": problem.horizon,
            "unit": problem.unit,
            "seed": problem.seed,
            "options": dict(problem.options),
            "baseline": structs.asdict(self.baseline),
        }
        if self.reference is not None:
            name, m1 = self.reference.scheduler, self.reference.M1.as_json()
            data["reference"] = {"scheduler": name, "view": {"kind": "full"}, "M1": m1}
        data["schedulers"] = {name: one.as_json(self.baseline.scheduler) for name, one in self.schedulers.items()}
        data["by_instance"] = to_builtins(self.by_instance)
        return data


def view_in_short(view: Mapping[str, Any]) -> str:
    """`local reach 1 comm 1`, from a view's JSON."""
    return " ".join([str(view["kind"]), *(f"{name} {value}" for name, value in view.items() if name != "kind")])

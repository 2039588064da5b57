"""Schedulers held against each other on the same instances with the same noise (dissertation, section 6.5.2).

Randomness is counter-based, so common random numbers cost nothing: entry (i, e) of every scheduler's scores is
episode e of instance i, whatever the order, the batch or the process it was played in. M1 is an episode's mean
of the objective, M2 its gain in percent over the domain's reference scheduler on the same instance. The
reference always plays with the full view, as published; paired differences are taken to it unless another
baseline is named, which is then one of the table's schedulers under the table's view.

    table = evaluate(Problem("airme", count=20, seed=1), {"corrective": scheduler})
    write_json(path, table.as_json())
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.agents.playing import play
from marl_sched.errors import InvalidOptionError, require
from marl_sched.graph import VISIBLE_SHARE
from marl_sched.privileged import PrivilegedInfo
from marl_sched.problem import Problem, view_as_json
from marl_sched.simulation import TurnSimulator
from marl_sched.statistics import Summary, paired_difference, percent_gain, summarise
from marl_sched.train.evaluation.agents import joined_figures, summarise_agents
from marl_sched.train.evaluation.gaps import by_instance, gaps, mean_of
from marl_sched.train.evaluation.results import Baseline, Measure, Reference, Results, SchedulerResults

EXACT = "exact"  # the scheduler that the others' gap is taken to where it plays
SHARE_EVERY = 8  # turns between two readings of the visible share
_CHUNK_CELLS = 2048 * 41 * 16  # pairs of action and agent in flight: 2048 rows of 40 actions, 288 of 145 with 32 agents

Progress = Callable[[float], None]
"""Told the share of the work that is done, in [0, 1]."""
Ended = Callable[[TurnSimulator, range], None]
"""Given a simulator whose episodes are over; its row k is episode `rows[k] % episodes` of `rows[k] // episodes`."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What one scheduler reached; entry (i, e) is episode e of instance i.

    Attributes:
        measures: the simulator's `objectives()` at the end of each episode, name -> float64 (I, E).
        visible_share: share of the graph that acting agents saw, mean over turns.
        seconds: wall time of all episodes, simulation included.
        per_round: the simulator's and the scheduler's `per_round()`, name -> float64 (I, E, rounds).
        agents: the simulator's `agent_figures()` at the end of each episode, name -> float64 (I, E, agents).
        privileged_info: what the scheduler uses beyond the acting agent's observation.
    """

    measures: Mapping[str, np.ndarray]
    visible_share: float
    seconds: float
    privileged_info: PrivilegedInfo = PrivilegedInfo.NONE
    per_round: Mapping[str, np.ndarray] = field(default_factory=dict)
    agents: Mapping[str, np.ndarray] = field(default_factory=dict)


def evaluate_scheduler(
    problem: Problem,
    scheduler: Scheduler,
    *,
    max_rows: int | None = None,
    progress: Progress | None = None,
    ended: Ended | None = None,
) -> Scores:
    """Play the problem's episodes of every instance, many in lock-step, at most `max_rows` at a time.

    Envs never influence each other, so neither `max_rows` (default: as many as keep memory small) nor the
    order of the instances changes a rule's scores; a network's logits differ in the last digits. `ended` is called
    with every simulator whose episodes are over, and the numbers of its rows.
    """
    started = time.perf_counter()
    total = problem.count * problem.episodes
    measures: list[dict[str, np.ndarray]] = []
    per_round: list[dict[str, np.ndarray]] = []
    agents: list[dict[str, np.ndarray]] = []
    shares = _Shares(total, progress)
    for rows in _chunks(total, max_rows or _rows_that_fit(problem)):
        simulator = problem.simulator([row // problem.episodes for row in rows], **own_options(scheduler, problem))
        episodes = problem.episode_numbers(row % problem.episodes for row in rows)
        simulator.reset(seed=problem.seed, episodes=episodes)
        shares.begin(rows.start)
        play(scheduler, simulator, shares)
        if ended is not None:
            ended(simulator, rows)
        measures.append(simulator.objectives())
        agents.append(simulator.agent_figures())
        per_round.append({**simulator.per_round(), **scheduler.per_round()})
    return Scores(
        measures=_joined(measures, problem.count),
        per_round=_joined(per_round, problem.count),
        agents=joined_figures(agents, problem.count),
        visible_share=shares.mean,
        seconds=time.perf_counter() - started,
        privileged_info=scheduler.privileged_info,
    )


def own_options(scheduler: Scheduler, problem: Problem) -> dict[str, Any]:
    """The simulator's options that belong to a scheduler, where the problem does not choose others."""
    return {name: value for name, value in scheduler.simulator_options.items() if name not in problem.options}


class _Shares:
    """Watches episodes: reads the visible share at every few decisions, and tells how far they are."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self.start, self._total, self._progress = 0, total, progress
        self._sum, self._turns = 0.0, 0

    def begin(self, start: int) -> None:
        """Look on at the episodes from number `start` on."""
        self.start = start
        if self._progress is not None:
            self._progress(start / self._total)

    def before(self, simulator: TurnSimulator, number: int) -> None:
        """Read the shares of the acting agents at every few decisions."""
        if number % SHARE_EVERY:
            return
        acting = simulator.acting >= 0
        # in float64 sums of these float32 are exact, so that the order of the envs does not matter
        shares = simulator.observe(simulator.acting)[VISIBLE_SHARE].astype(np.float64)
        self.played(simulator, float(shares[acting].sum()), int(acting.sum()))

    def played(self, simulator: TurnSimulator, shares: float, decisions: int) -> None:
        """Take over the sum of the shares that so many decisions were made on."""
        self._sum, self._turns = self._sum + shares, self._turns + decisions
        if self._progress is not None:
            played = float(simulator.progress_share.mean())
            self._progress((self.start + simulator.batch * played) / self._total)

    @property
    def mean(self) -> float:
        """Mean over the decisions read."""
        return float(self._sum / self._turns)


def _joined(parts: list[dict[str, np.ndarray]], n_instances: int) -> dict[str, np.ndarray]:
    """Arrays of consecutive rows, name -> (rows, ...), as one of shape (I, E, ...)."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {name: values.reshape(n_instances, -1, *values.shape[1:]) for name, values in whole.items()}


def _chunks(total: int, size: int) -> Iterator[range]:
    for start in range(0, total, size):
        yield range(start, min(start + size, total))


def _rows_that_fit(problem: Problem) -> int:
    # a scale sets the padding by itself; without one the largest instance does
    sizes = problem.simulator(None if problem.pad is None else [0], view=None)
    return max(1, _CHUNK_CELLS // (sizes.max_actions * max(sizes.max_agents, 16)))


@dataclass(frozen=True, kw_only=True)
class Table:
    """Schedulers side by side, with all their scores.

    Attributes:
        problem: what was played.
        scores: name as the user typed it -> scores.
        reference: the name of what M2 is the gain over, and its scores under the full view; None where the
            domain has no reference scheduler.
        baseline: what paired differences are taken to: its name, the view it played with, its scores.
    """

    problem: Problem
    scores: Mapping[str, Scores]
    reference: tuple[str, Scores] | None
    baseline: tuple[str, Any, Scores]

    def results(self) -> Results:
        """What was found, as values."""
        problem, objective = self.problem, self.problem.objective
        held_against = None
        if self.reference is not None:
            name, scores = self.reference
            held_against = Reference(scheduler=name, M1=summarise(scores.measures[objective]))
        return Results(
            problem=problem,
            baseline=Baseline(scheduler=self.baseline[0], view=view_as_json(self.baseline[1])),
            reference=held_against,
            schedulers={name: self._row(scores) for name, scores in self.scores.items()},
            by_instance=by_instance(problem, self.scores),
        )

    def as_json(self) -> dict[str, Any]:
        """The results as a file has them."""
        return self.results().as_json()

    def _row(self, scores: Scores) -> SchedulerResults:
        objective = self.problem.objective
        m1 = scores.measures[objective]
        gap_to_exact, gap_to_bound = None, None
        if EXACT in self.scores:
            gap_to_exact, gap_to_bound = gaps(scores, self.scores[EXACT], objective)
        return SchedulerResults(
            M1=summarise(m1),
            scores=m1.tolist(),
            M2=self._gain(m1),
            measures=_measures(scores),
            gap_to_exact=gap_to_exact,
            gap_to_bound=gap_to_bound,
            difference=paired_difference(m1, self.baseline[2].measures[objective]),
            visible_share=scores.visible_share,
            privileged_info=scores.privileged_info,
            agents=summarise_agents(scores.agents, self._agents) if scores.agents else None,
            seconds=scores.seconds,
        )

    @property
    def _agents(self) -> list[str] | None:
        """The agents' names where there is one instance only."""
        if self.problem.count > 1:
            return None
        return self.problem.domain.agent_names(self.problem.instances[0], int(self.problem.simulator().n_agents[0]))

    def _gain(self, m1: np.ndarray) -> Summary | None:
        """Gain over the reference in percent, positive for a gain."""
        if self.reference is None:
            return None
        gain = percent_gain(m1, self.reference[1].measures[self.problem.objective])
        return summarise(-gain if self.problem.domain.better == "lower" else gain)


def _measures(scores: Scores) -> dict[str, Measure]:
    """All that was measured of a scheduler: statistics by episode, means by round."""
    found = {}
    for name, values in scores.measures.items():
        summary = summarise(values)
        found[name] = Measure(mean=summary.mean, summary=summary)
    for name, values in scores.per_round.items():
        whole = found.get(name)
        found[name] = Measure(
            mean=mean_of(values) if whole is None else whole.mean,
            summary=None if whole is None else whole.summary,
            per_round=[mean_of(values[..., k]) for k in range(values.shape[-1])],
        )
    return found


def evaluate(
    problem: Problem,
    schedulers: Mapping[str, Scheduler],
    *,
    reference: Scheduler | None = None,
    baseline: str | None = None,
    progress: Callable[[str, float], None] | None = None,
    ended: Callable[[str, TurnSimulator, range], None] | None = None,
) -> Table:
    """Play every scheduler and the reference on the same episodes.

    `reference` is what M2 is the gain over; it plays with the full view, and only once if it is in the table
    with that view already. `baseline` names one of the schedulers, which stands for itself under the view of
    the table; None is the reference under the full view, or the first scheduler where there is no reference.
    `progress` is told a scheduler's name and the share of its work that is done, `ended` its name and what
    `evaluate_scheduler` tells. Raises UnknownNameError for
    a baseline that is not in the table.
    """
    if not schedulers:
        raise InvalidOptionError("schedulers: expected at least one")
    if baseline is not None:
        require("baseline", baseline, schedulers)

    def scores_of(name: str, scheduler: Scheduler, problem: Problem) -> Scores:
        report = None if progress is None else lambda done: progress(name, done)
        told = None if ended is None else lambda simulator, rows: ended(name, simulator, rows)
        return evaluate_scheduler(problem, scheduler, progress=report, ended=told)

    scores = {name: scores_of(name, scheduler, problem) for name, scheduler in schedulers.items()}
    held_against = None
    if reference is not None:
        if reference.name in scores and view_as_json(problem.view)["kind"] == "full":
            under_full_view = scores[reference.name]
        else:
            under_full_view = scores_of(reference.name, reference, problem.but(view=None))
        held_against = (reference.name, under_full_view)
    return Table(
        problem=problem,
        scores=scores,
        reference=held_against,
        baseline=_baseline(baseline, scores, problem.view, held_against),
    )


def _baseline(
    name: str | None, scores: Mapping[str, Scores], view: Any, reference: tuple[str, Scores] | None
) -> tuple[str, Any, Scores]:
    """Name, view and scores of what differences are taken to; no name means the reference under the full view."""
    if name is None and reference is not None:
        return reference[0], None, reference[1]
    name = next(iter(scores)) if name is None else name
    return name, view, scores[name]

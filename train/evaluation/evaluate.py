"""Schedulers held against each other on the same instances with the same noise (dissertation, section 6.5.2).

Randomness is counter-based, so common random numbers cost nothing: entry (i, e) of every scheduler's scores is
episode e of instance i, whatever the order, the batch or the process it was played in. M1 is an episode's mean
of the objective, M2 its gain in percent over the domain's reference scheduler on the same instance. The
reference always plays with the full view, as published; paired differences are taken to it unless another
baseline is named, which is then one of the table's schedulers under the table's view.

    table = evaluate(domain, {"corrective": scheduler}, instances, Settings(episodes=10, seed=1))
    write_json(path, table.as_json())
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from typing import Any

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.domain import Domain
from marl_sched.errors import InvalidOptionError, require
from marl_sched.graph import VISIBLE_SHARE
from marl_sched.simulation import TurnSimulator
from marl_sched.statistics import Summary, paired_difference, percent_gain, summarise

SCHEMA = 1
EXACT = "exact"  # the scheduler that the others' gap is taken to where it plays
SHARE_EVERY = 8  # turns between two readings of the visible share
EPOCHS_AT_ONCE = 24  # between two reports of progress, where a scheduler plays decision epochs in compiled code
LOCAL_SHARE = 0.45  # a view that shows more of the graph than this is not called local
_CHUNK_CELLS = 2048 * 41 * 16  # pairs of action and agent in flight: 2048 rows of a small AirME fleet, 288 of a large

Progress = Callable[[float], None]
"""Told the share of the work that is done, in [0, 1]."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What all schedulers of a table have in common.

    Attributes:
        episodes: episodes of each instance.
        seed: of the noise.
        view: an instance of one of the domain's views; None is the full one.
        objective: what M1 is the mean of; None is the domain's default.
        horizon: simulated time of an episode; None is the domain's default.
        scale: name of the scale that the instances are drawn from; it sets the padding. None: they are a
            user's own, the padding is that of the largest.
        options: more options of the domain's simulator.
    """

    episodes: int = 10
    seed: int = 0
    view: Any = None
    objective: str | None = None
    horizon: int | None = None
    scale: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse settings under which there is nothing to evaluate."""
        if self.episodes < 1:
            raise InvalidOptionError(f"episodes: expected an integer >= 1, got {self.episodes}")

    def simulator(self, domain: Domain, instances: Sequence[Any], **changes: Any) -> TurnSimulator:
        """The domain's simulator with these settings; `changes` go before them."""
        filled = self.filled_in(domain)
        options = {
            "view": filled.view,
            "objective": filled.objective,
            "horizon": filled.horizon,
            "seed": filled.seed,
            "pad": filled.scale,
            **filled.options,
        }
        return domain.simulator(instances, **{**options, **changes})

    def filled_in(self, domain: Domain) -> Settings:
        """These settings with the domain's defaults for objective and horizon."""
        return replace(
            self,
            objective=domain.objectives[0] if self.objective is None else self.objective,
            horizon=domain.default_horizon if self.horizon is None else self.horizon,
        )


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What one scheduler reached; entry (i, e) is episode e of instance i.

    Attributes:
        measures: the simulator's `objectives()` at the end of each episode, name -> float64 (I, E).
        visible_share: share of the graph that acting agents saw, mean over turns.
        seconds: wall time of all episodes, simulation included.
        per_round: the simulator's and the scheduler's `per_round()`, name -> float64 (I, E, rounds).
        needs: what the scheduler uses beyond the acting agent's observation, "" for nothing.
    """

    measures: Mapping[str, np.ndarray]
    visible_share: float
    seconds: float
    needs: str = ""
    per_round: Mapping[str, np.ndarray] = field(default_factory=dict)


def evaluate_scheduler(
    domain: Domain,
    scheduler: Scheduler,
    instances: Sequence[Any],
    settings: Settings,
    *,
    max_rows: int | None = None,
    progress: Progress | None = None,
) -> Scores:
    """Play `settings.episodes` episodes of every instance, many in lock-step, at most `max_rows` at a time.

    Rows never influence each other, so neither `max_rows` (default: as many as keep memory small) nor the
    order of the instances changes a rule's scores; a network's logits differ in the last digits.
    """
    if not instances:
        raise InvalidOptionError("instances: expected at least one")
    started = time.perf_counter()
    total = len(instances) * settings.episodes
    measures: list[dict[str, np.ndarray]] = []
    per_round: list[dict[str, np.ndarray]] = []
    shares, turns = 0.0, 0
    for rows in _chunks(total, max_rows or _rows_that_fit(domain, instances, settings)):
        chosen = [instances[row // settings.episodes] for row in rows]
        simulator = settings.simulator(domain, chosen, **own_options(scheduler, settings))
        simulator.reset(seed=settings.seed, episodes=[row % settings.episodes for row in rows])
        scheduler.start(simulator, np.ones(simulator.batch, np.bool_))
        player = scheduler.epoch_player(simulator)
        while player is not None and (simulator.acting >= 0).any():
            if progress is not None:
                progress((rows.start + len(rows) * _played(simulator)) / total)
            seen, decisions = player(EPOCHS_AT_ONCE)
            shares, turns = shares + seen, turns + decisions
        for turn in count():
            acting = simulator.acting >= 0
            if not acting.any():
                break
            if turn % SHARE_EVERY == 0:
                shares += _visible_share(simulator)[acting].sum()
                turns += int(acting.sum())
                if progress is not None:
                    progress((rows.start + len(rows) * _played(simulator)) / total)
            simulator.step(scheduler.decide(simulator))
        measures.append(simulator.objectives())
        per_round.append({**simulator.per_round(), **scheduler.per_round()})
    return Scores(
        measures=_joined(measures, len(instances)),
        per_round=_joined(per_round, len(instances)),
        visible_share=float(shares / turns),
        seconds=time.perf_counter() - started,
        needs=str(scheduler.privileged_info),
    )


def own_options(scheduler: Scheduler, settings: Settings) -> dict[str, Any]:
    """The simulator's options that belong to a scheduler, where the settings do not choose others."""
    return {name: value for name, value in scheduler.simulator_options.items() if name not in settings.options}


def _joined(parts: list[dict[str, np.ndarray]], n_instances: int) -> dict[str, np.ndarray]:
    """Arrays of consecutive rows, name -> (rows, ...), as one of shape (I, E, ...)."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return {name: values.reshape(n_instances, -1, *values.shape[1:]) for name, values in whole.items()}


def _visible_share(simulator: TurnSimulator) -> np.ndarray:
    # in float64 sums of these float32 are exact, so that the order of the rows does not matter
    return simulator.observe(simulator.acting)[VISIBLE_SHARE].astype(np.float64)


def _played(simulator: TurnSimulator) -> float:
    horizon = getattr(simulator, "horizon", None)
    return float(np.where(simulator.over, 1.0, simulator.time / horizon if horizon else 0.0).mean())


def _chunks(total: int, size: int) -> Iterator[range]:
    for start in range(0, total, size):
        yield range(start, min(start + size, total))


def _rows_that_fit(domain: Domain, instances: Sequence[Any], settings: Settings) -> int:
    # a scale sets the padding by itself; a user's own instances are padded to their largest
    sizes = settings.simulator(domain, instances if settings.scale is None else instances[:1], view=None)
    return max(1, _CHUNK_CELLS // (sizes.max_actions * max(sizes.max_agents, 16)))


@dataclass(frozen=True, kw_only=True)
class Table:
    """Schedulers side by side: what every plot and every printed table is drawn from.

    Attributes:
        domain: what was played.
        settings: with objective and horizon filled in.
        n_instances: number of instances.
        scores: name as the user typed it -> scores.
        reference: the name of what M2 is the gain over, and its scores under the full view; None where the
            domain has no reference scheduler.
        baseline: what paired differences are taken to: its name, the view it played with, its scores.
    """

    domain: Domain
    settings: Settings
    n_instances: int
    scores: Mapping[str, Scores]
    reference: tuple[str, Scores] | None
    baseline: tuple[str, Any, Scores]

    def as_json(self) -> dict[str, Any]:
        """The table as schema 1 of `marl-sched evaluate --json`."""
        settings = self.settings
        data: dict[str, Any] = {
            "schema": SCHEMA,
            "env": self.domain.name,
            "scale": settings.scale,
            "objective": settings.objective,
            "better": self.domain.better,
            "view": {
                **view_as_json(settings.view),
                "visible_share": self.visible_share,
                "local": self.visible_share <= LOCAL_SHARE,
            },
            "instances": self.n_instances,
            "episodes": settings.episodes,
            self.domain.unit: settings.horizon,
            "seed": settings.seed,
            "options": dict(settings.options),
            "baseline": {"scheduler": self.baseline[0], "view": view_as_json(self.baseline[1])},
        }
        if self.reference is not None:
            name, scores = self.reference
            m1 = self._summary(scores.measures[str(settings.objective)])
            data["reference"] = {"scheduler": name, "view": {"kind": "full"}, "M1": m1.as_json()}
        data["schedulers"] = {name: self._row(scores) for name, scores in self.scores.items()}
        return data

    @property
    def visible_share(self) -> float:
        """Share of the graph that acting agents saw, mean over the schedulers."""
        return float(np.mean([scores.visible_share for scores in self.scores.values()]))

    def _row(self, scores: Scores) -> dict[str, Any]:
        objective = str(self.settings.objective)
        m1 = scores.measures[objective]
        row: dict[str, Any] = {"M1": self._summary(m1).as_json()}
        if self.reference is not None:
            gain = percent_gain(m1, self.reference[1].measures[objective])
            row["M2"] = self._summary(gain).as_json()
        for name, values in scores.measures.items():
            row[name] = row["M1"] if name == objective else self._summary(values).as_json()
        for name, values in scores.per_round.items():
            row[name] = {"mean": _mean(values), **row.get(name, {}), "per_round": _by_round(values)}
        if EXACT in self.scores:
            gap = percent_gain(m1, self.scores[EXACT].measures[objective])
            row["gap_to_exact"] = self._summary(gap).as_json()
        difference = paired_difference(m1, self.baseline[2].measures[objective])
        row["difference"] = {"to": self.baseline[0], **difference.as_json()}
        row["visible_share"] = scores.visible_share
        row["local"] = scores.visible_share <= LOCAL_SHARE
        row["needs"] = scores.needs
        row["seconds"] = scores.seconds
        return row

    def _summary(self, values: np.ndarray) -> Summary:
        # the same resamples for every row: intervals of equal scores are equal
        return summarise(values, np.random.default_rng(self.settings.seed))


def evaluate(
    domain: Domain,
    schedulers: Mapping[str, Scheduler],
    instances: Sequence[Any],
    settings: Settings,
    *,
    reference: Scheduler | None = None,
    baseline: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Table:
    """Play every scheduler and the reference on the same episodes.

    `reference` is what M2 is the gain over; it plays with the full view, and only once if it is in the table
    with that view already. `baseline` names one of the schedulers, which stands for itself under the view of
    the table; None is the reference under the full view, or the first scheduler where there is no reference.
    `progress` is told a scheduler's name and the share of its work that is done. Raises UnknownNameError for
    a baseline that is not in the table.
    """
    if not schedulers:
        raise InvalidOptionError("schedulers: expected at least one")
    if baseline is not None:
        require("baseline", baseline, schedulers)
    settings = settings.filled_in(domain)

    def play(name: str, scheduler: Scheduler, settings: Settings) -> Scores:
        report = None if progress is None else lambda done: progress(name, done)
        return evaluate_scheduler(domain, scheduler, instances, settings, progress=report)

    scores = {name: play(name, scheduler, settings) for name, scheduler in schedulers.items()}
    held_against = None
    if reference is not None:
        if reference.name in scores and view_as_json(settings.view)["kind"] == "full":
            under_full_view = scores[reference.name]
        else:
            under_full_view = play(reference.name, reference, replace(settings, view=None))
        held_against = (reference.name, under_full_view)
    return Table(
        domain=domain,
        settings=settings,
        n_instances=len(instances),
        scores=scores,
        reference=held_against,
        baseline=_baseline(baseline, scores, settings.view, held_against),
    )


def _baseline(
    name: str | None, scores: Mapping[str, Scores], view: Any, reference: tuple[str, Scores] | None
) -> tuple[str, Any, Scores]:
    """Name, view and scores of what differences are taken to; no name means the reference under the full view."""
    if name is None and reference is not None:
        return reference[0], None, reference[1]
    name = next(iter(scores)) if name is None else name
    return name, view, scores[name]


def _mean(values: np.ndarray) -> float | None:
    """The mean of what was measured, None if nothing was; JSON knows no NaN."""
    measured = values[~np.isnan(values)]
    return float(measured.mean()) if measured.size else None


def _by_round(values: np.ndarray) -> list[float | None]:
    return [_mean(values[..., k]) for k in range(values.shape[-1])]


def view_as_json(view: Any) -> dict[str, Any]:
    """`{"kind": "local", "reach": 1, ...}`; None is the full view."""
    return {"kind": "full"} if view is None else {"kind": view.kind, **asdict(view)}

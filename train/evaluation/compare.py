"""What `marl-sched compare` adds to the numbers: pictures, each drawn from something that is at hand as a file.

Bars are drawn from results and learning curves from training logs as CSV; a timeline is one episode
played again, which counter-based randomness makes the same one.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from marl_sched.agents.base import Scheduler
from marl_sched.agents.playing import play
from marl_sched.domain import Domain
from marl_sched.errors import InvalidFileError
from marl_sched.problem import Problem
from marl_sched.simulation import TurnSimulator
from marl_sched.train.evaluation import plots
from marl_sched.train.evaluation.evaluate import own_options
from marl_sched.train.evaluation.results import Results

SECONDS, SCORE = "seconds", "validation"  # the columns of a training log that are drawn


def draw_scores(path: Path, *results: Results) -> Path:
    """The bars of one or more evaluations as a picture; its path."""
    return plots.save(plots.score_bars(*results), path)


def draw_timelines(path: Path, domain: Domain, episodes: Mapping[str, TurnSimulator], objective: str) -> Path:
    """Finished episodes, caption -> what `play_episode` returned, one above the other as a picture; its path."""
    captions = {
        f"{name}: {objective} {simulator.objectives()[objective][0]:.3f}": simulator
        for name, simulator in episodes.items()
    }
    title = "the same instance with the same noise"
    if domain.episode_figure is not None:
        return plots.save(domain.episode_figure(captions, title=title), path)
    figure = plots.timelines(
        {caption: domain.render["rgb_array"](simulator, 0) for caption, simulator in captions.items()},
        length=max(int(simulator.time[0]) for simulator in episodes.values()),
        unit=next(iter(episodes.values())).time_unit,
        legend=domain.legend,
        band=domain.band,
        title=title,
    )
    return plots.save(figure, path)


def draw_learning_curves(path: Path, logs: Iterable[Path], *, better: str) -> Path:
    """The learning curves of training logs as a picture; its path. `better`: which score is, "higher" or "lower".

    Each is named after its run's folder, or as it was given where folders of several have the same name. Raises
    InvalidFileError for what is no log.
    """
    folders = {log: log.absolute().parent.name for log in logs}
    often = Counter(folders.values())
    curves = {str(log) if often[name] > 1 else name: read_learning_curve(log) for log, name in folders.items()}
    return plots.save(plots.learning_curves(curves, better=better), path)


def play_episode(problem: Problem, scheduler: Scheduler, index: int = 0) -> TurnSimulator:
    """The simulator after episode 0 of an instance, with what its pictures are drawn from on record."""
    options = {**own_options(scheduler, problem), **problem.domain.render_options.get("rgb_array", {})}
    simulator = problem.simulator([index], **options)
    simulator.reset(seed=problem.seed, episodes=problem.episode_numbers([0]))
    return play(scheduler, simulator)


def read_learning_curve(log: Path) -> tuple[np.ndarray, np.ndarray]:
    """Minutes and validation scores, float64 (N,) each, of a training log; InvalidFileError if it is none."""
    seconds, scores = read_curve(log, (SECONDS,), SCORE)
    return seconds / 60, scores


def read_curve(log: Path, xs: Sequence[str], y: str) -> tuple[np.ndarray, np.ndarray]:
    """Two columns of a training log, float64 (N,) each, in the rows that have a value of `y`.

    The first is the first of `xs` that the log has.

    Raises InvalidFileError for a file that is not such a log.
    """
    try:
        with log.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise InvalidFileError(log, "", f"a readable file ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InvalidFileError(log, f"byte {error.start}", "UTF-8 text") from error
    x = next((name for name in xs if rows and rows[0].get(name) is not None), xs[0])
    points = []
    for line, row in enumerate(rows, start=2):
        for column in (x, y):
            if row.get(column) is None:
                raise InvalidFileError(log, f"line {line}", f"a column {column!r}")
        if row[y] == "":
            continue
        try:
            points.append((float(row[x]), float(row[y])))
        except ValueError as error:
            raise InvalidFileError(log, f"line {line}", "numbers", f"{row[x]}, {row[y]}") from error
    if not points:
        raise InvalidFileError(log, "", f"at least one row with a value of {y!r}")
    along, values = np.array(points).T
    return along, values

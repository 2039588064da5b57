"""Drawing MuRSE instances: every setting of the dissertation by name (sections 3.5, 4.4.1, 4.4.4, 4.5.1, 5.7.1).

`small`, `medium` and `large` are the human-robot teams of chapter 5. The robot teams of chapters 3 and 4 are
`robots-*` (chapter 3, two to five robots, five locations), `homogeneous-R-*` and `heterogeneous-R-*` (chapter
4, R robots) and `weighted-5-*` (section 4.4.4, task costs for the weighted completion time).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE, MurseInstance
from marl_sched.envs.murse.learning import sample_curves
from marl_sched.errors import InvalidOptionError, UnknownNameError

CONSTRAINED = 0.25
"""Share of tasks with a deadline, and share with a wait."""
MAX_ATTEMPTS = 1000


@dataclass(frozen=True, kw_only=True)
class Scale:
    """What the generator draws; bounds include both ends.

    Attributes:
        tasks, agents: how many.
        with_humans: at least one robot and one human, any split; otherwise robots only.
        team: all robots alike, each task with a mean and a gap of its own (section 4.5.1), or all independent.
        durations: range of a robot's durations and limits of a human's.
        deadline_per_task: deadlines are at most this x number of tasks.
        wait: waits are uniform on [1, this].
        map_size: side of the square of whole coordinates from 1, or the number of locations in a row.
        proximity: what keeps tasks apart.
        weights: range of task costs, or None for equal ones.
        rounds: of an episode.
    """

    tasks: tuple[int, int]
    agents: tuple[int, int]
    with_humans: bool = False
    team: Literal["alike", "gap", "independent"] = "alike"
    durations: tuple[int, int] = (1, 10)
    deadline_per_task: int
    wait: int = 10
    map_size: int
    proximity: Literal["distance", "location"] = "location"
    weights: tuple[float, float] | None = None
    rounds: int = 1


_ROBOT_TASKS = {"small": (16, 20), "medium": (40, 50), "large": (80, 100), "xlarge": (160, 200)}


def _scales() -> dict[str, Scale]:
    scales: dict[str, Scale] = {}
    for size, tasks in (("small", (9, 11)), ("medium", (18, 22)), ("large", (36, 44))):
        scales[size] = Scale(
            tasks=tasks, agents=(3, 5), with_humans=True, team="independent", durations=(15, 100),
            deadline_per_task=25, wait=50, map_size=5, proximity="distance", rounds=10,
        )  # fmt: skip
    for size in ("small", "medium", "large"):
        scales[f"robots-{size}"] = Scale(tasks=_ROBOT_TASKS[size], agents=(2, 5), deadline_per_task=3, map_size=5)
    for robots, per_task, side in ((2, 5, 2), (5, 2, 3), (10, 1, 5)):
        for size in ("small", "medium", "large", *(("xlarge",) if robots == 10 else ())):
            common: dict[str, Any] = {
                "tasks": _ROBOT_TASKS[size],
                "agents": (robots, robots),
                "deadline_per_task": per_task,
            }
            scales[f"homogeneous-{robots}-{size}"] = Scale(**common, map_size=robots)
            scales[f"heterogeneous-{robots}-{size}"] = Scale(**common, team="gap", map_size=side, proximity="distance")
            if robots == 5 and size != "large":
                scales[f"weighted-5-{size}"] = Scale(**common, map_size=robots, weights=(1.0, 10.0))
    return scales


SCALES: dict[str, Scale] = _scales()


def generate(
    scale: str, rng: np.random.Generator, accept: Callable[[MurseInstance], bool] | None = None
) -> MurseInstance:
    """Draw an instance of a scale; with `accept`, draw until one is accepted.

    `accept` is, for example, a solver's proof that a feasible schedule exists. Without it, no schedule may be
    feasible, but no single deadline is hopeless. Raises UnknownNameError for a scale that is
    not one of SCALES, InvalidOptionError when none of MAX_ATTEMPTS instances is accepted.
    """
    if scale not in SCALES:
        raise UnknownNameError("scale of murse", scale, SCALES)
    for _ in range(MAX_ATTEMPTS):
        instance = _draw(SCALES[scale], rng)
        if accept is None or accept(instance):
            return instance
    raise InvalidOptionError(f"scale {scale!r}: none of {MAX_ATTEMPTS} instances was accepted")


def _draw(scale: Scale, rng: np.random.Generator) -> MurseInstance:
    n = int(rng.integers(scale.tasks[0], scale.tasks[1] + 1))
    n_agents = int(rng.integers(scale.agents[0], scale.agents[1] + 1))
    n_robots = int(rng.integers(1, n_agents)) if scale.with_humans else n_agents
    n_humans = n_agents - n_robots
    low, high = scale.durations
    curves = sample_curves(rng, n * n_humans, (2.0 * low, float(high))) if n_humans else np.empty(0)
    relaxed = MurseInstance(
        robot_durations=_robot_durations(scale, n, n_robots, rng),
        curves=curves.reshape(n, n_humans, 6),
        deadlines=np.full(n, NO_DEADLINE),
        waits=_waits(scale, n, rng),
        locations=_locations(scale, n, rng),
        weights=np.ones(n) if scale.weights is None else rng.uniform(*scale.weights, n),
        proximity=scale.proximity,
        duration_range=scale.durations,
        n_rounds=scale.rounds,
        map_width=float(scale.map_size),
    )
    return replace(relaxed, deadlines=_deadlines(scale, relaxed, rng))


def _deadlines(scale: Scale, relaxed: MurseInstance, rng: np.random.Generator) -> np.ndarray:
    """Uniform on [1, deadline_per_task x tasks] for about a quarter of the tasks, given that none is hopeless.

    Drawn without that condition, half of the problems would have a deadline before the first round's earliest
    finish, which the dissertation's solving rates of 80 to 90 percent exclude. A task that cannot end within the
    range has no deadline.
    """
    latest = scale.deadline_per_task * relaxed.n_tasks
    earliest = relaxed.earliest_finishes(relaxed.mean_durations)
    constrained = (rng.random(relaxed.n_tasks) < CONSTRAINED) & (earliest <= latest)
    drawn = rng.integers(np.minimum(earliest, latest), latest + 1)
    return np.where(constrained, drawn, NO_DEADLINE)


def _robot_durations(scale: Scale, n: int, n_robots: int, rng: np.random.Generator) -> np.ndarray:
    low, high = scale.durations
    if scale.team == "alike":
        return np.repeat(rng.integers(low, high + 1, (n, 1)), n_robots, axis=1)
    if scale.team == "independent":
        return rng.integers(low, high + 1, (n, n_robots))
    mean, gap = rng.integers(low, high + 1, (n, 1)), rng.integers(1, 4, (n, 1))
    return np.clip(rng.integers(mean - gap, mean + gap + 1, (n, n_robots)), low, high)


def _waits(scale: Scale, n: int, rng: np.random.Generator) -> np.ndarray:
    """About a quarter of the tasks wait for one other task that stands before them in a random order.

    The order makes a cycle of waits impossible.
    """
    order = rng.permutation(n)
    waiting = [place for place in range(1, n) if rng.random() < CONSTRAINED]
    rows = [(order[place], order[rng.integers(place)], rng.integers(1, scale.wait + 1)) for place in waiting]
    return np.array(rows, np.int64).reshape(-1, 3)


def _locations(scale: Scale, n: int, rng: np.random.Generator) -> np.ndarray:
    x = rng.integers(1, scale.map_size + 1, n)
    y = rng.integers(1, scale.map_size + 1, n) if scale.proximity == "distance" else np.zeros(n)
    return np.stack([x, y], axis=1).astype(np.float64)

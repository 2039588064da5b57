"""Small MuRSE problems that can be worked out by hand, random ones, and players for them."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st

from marl_sched.envs.murse.instance import INELIGIBLE, MurseInstance
from marl_sched.envs.murse.simulator import MurseSimulator


def problem(robots: list[list[int]], **changed: Any) -> MurseInstance:
    """Tasks with these robot durations, 0 for ineligible, one place each, and whatever else is given."""
    n = len(robots)
    values: dict[str, Any] = {
        "robot_durations": [[duration or INELIGIBLE for duration in row] for row in robots],
        "curves": np.zeros((n, 0, 6)),
        "deadlines": [-1] * n,
        "waits": [],
        "locations": [[10.0 * i, 0.0] for i in range(n)],
        "weights": [1.0] * n,
        "duration_range": (1, 100),
    }
    return MurseInstance(**(values | changed))


def three_tasks(**changed: Any) -> MurseInstance:
    """Two alike robots; durations 4, 3, 2; task 3 at least 5 after task 1; tasks 1 and 2 share a place."""
    values = {"waits": [(2, 0, 5)], "locations": [[1, 1], [1, 1], [5, 5]], "proximity": "location"}
    return problem([[4, 4], [3, 3], [2, 2]], **(values | changed))


def played(simulator: MurseSimulator, actions: list[int]) -> MurseSimulator:
    """The one-row simulator after these choices in turn."""
    for action in actions:
        simulator.step(np.array([action]))
    return simulator


def play_randomly(simulator: MurseSimulator, seed: int, idleness: float = 0.1) -> np.ndarray:
    """Play all rows to the end with legal choices, waiting with that weight; the rows' returns, float64 (B,)."""
    rng, total = np.random.default_rng(seed), np.zeros(simulator.batch)
    while not simulator.over.all():
        mask = simulator.legal().astype(float)
        mask[:, 0] = np.where(mask[:, 1:].any(axis=1), idleness, 1.0)
        simulator.step((mask * rng.random(mask.shape)).argmax(axis=1))
        total += simulator.reward
    return total


@st.composite
def instances(draw: st.DrawFn) -> MurseInstance:
    """Random problems of up to 7 tasks and 4 agents, with ineligible pairs, humans, deadlines and waits."""
    n, n_robots, n_humans = draw(st.integers(1, 7)), draw(st.integers(1, 3)), draw(st.integers(0, 2))
    durations = draw(
        st.lists(st.lists(st.integers(0, 9), min_size=n_robots, max_size=n_robots), min_size=n, max_size=n)
    )
    for each in durations:
        each[0] = max(each[0], 1)
    seed = draw(st.integers(0, 2**16))
    rng = np.random.default_rng(seed)
    curves = np.zeros((n, n_humans, 6))
    curves[:, :, [0, 2]] = rng.uniform(1, 6, (n, n_humans, 2))
    curves[:, :, [1, 3]] = rng.uniform(0, 2, (n, n_humans, 2))
    curves[:, :, 4], curves[:, :, 5] = 0.2, 0.05
    pairs = [(i, j, int(rng.integers(0, 9))) for i in range(n) for j in range(i) if rng.random() < 0.25]
    rename = rng.permutation(n)
    return MurseInstance(
        robot_durations=[[duration or INELIGIBLE for duration in row] for row in durations],
        curves=curves,
        deadlines=np.where(rng.random(n) < 0.3, rng.integers(1, 12 * n + 1, n), -1),
        waits=[(rename[i], rename[j], w) for i, j, w in pairs],
        locations=rng.integers(1, 4, (n, 2)),
        weights=rng.uniform(1, 10, n),
        proximity=draw(st.sampled_from(["distance", "location", "none"])),
        durations=draw(st.sampled_from(["deterministic", "stochastic"])),
        duration_range=(1, 12),
        n_rounds=draw(st.integers(1, 3)),
    )

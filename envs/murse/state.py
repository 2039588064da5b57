"""The arrays of a batch of MuRSE episodes: B rows, N task slots, A agent slots, R rounds.

Tasks and agents count from 0 here; action i + 1 is task i. All times are whole units from the round's start,
except a row's `time`, which runs on over the rounds.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from marl_sched.envs.murse.estimator import FILTER, Prior, new_filters, population_prior
from marl_sched.envs.murse.instance import INELIGIBLE, MurseInstance

NOBODY, NOTHING, NOT_WAITING = -1, -1, -1
NEVER = 1 << 40
"""The free time of an agent that waits for something that will not happen by itself."""

ROW = np.dtype(
    [
        ("episode", np.uint64),  # key of the noise
        ("n_tasks", np.int64),
        ("n_agents", np.int64),
        ("n_robots", np.int64),
        ("n_rounds", np.int64),
        ("learning", np.int64),  # code of the learning mode
        ("low", np.int64),  # range of human durations
        ("high", np.int64),
        ("round", np.int64),
        ("clock", np.int64),  # time within the round at which the acting agent decides
        ("origin", np.int64),  # `time` at the start of the round
        ("time", np.int64),  # origin + clock
        ("acting", np.int64),  # NOBODY: the episode is over
        ("limit", np.int64),  # no schedule without idleness takes longer, on the durations that decisions count on
        ("dispatched", np.int64),  # tasks of this round that have an agent
        ("conflicts", np.int64),  # of this round
        ("elapsed", np.int64),
        ("reward", np.float64),
        ("paid", np.float64),  # rewards of this round so far
        ("stochastic", np.bool_),
        ("conflict", np.bool_),
        ("terminated", np.bool_),
        ("truncated", np.bool_),  # always false: every end of a MuRSE episode is a termination
    ],
    align=True,
)
TASK = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("weight", np.float64),
        ("deadline", np.int64),  # NO_DEADLINE: none
        ("place", np.int64),  # index of its location
        ("agent", np.int64),  # who has it this round, NOBODY: unscheduled
        ("committed", np.int64),  # clock of the decision
        ("start", np.int64),  # plan: as planned; online: true
        ("finish", np.int64),
    ],
    align=True,
)
AGENT = np.dtype(
    [
        ("free_at", np.int64),  # when it decides next; NEVER: only when somebody commits
        ("waiting_since", np.int64),  # NOT_WAITING: it does not wait
        ("last_task", np.int64),  # NOTHING: it stands at the map's origin
    ],
    align=True,
)
PAIR = np.dtype(
    [
        ("true", np.int64),  # this round's duration, or INELIGIBLE
        ("planned", np.int64),  # whole duration that plans count on
        ("mean", np.float64),  # estimate
        ("spread", np.float64),  # standard deviation of the estimate and the noise
        ("repetitions", np.int64),
    ],
    align=True,
)
EXECUTED = np.dtype(
    [
        ("agent", np.int64),  # NOBODY: never dispatched
        ("position", np.int64),  # in the dispatch order
        ("committed", np.int64),
        ("start", np.int64),
        ("finish", np.int64),
    ],
    align=True,
)
ROUND = np.dtype(
    [
        ("makespan", np.int64),  # latest true finish
        ("weighted", np.float64),  # sum of weight x true finish
        ("worst", np.int64),  # largest sum of one agent's true durations over all tasks
        ("longest", np.int64),  # sum of every task's longest true duration and all waits
        ("conflicts", np.int64),
        ("stuck", np.bool_),  # tasks were left over
        ("feasible", np.bool_),
    ],
    align=True,
)


class State(NamedTuple):
    """Everything about a batch of episodes; instances' data stay as they are between resets."""

    rows: np.ndarray  # ROW (B,)
    tasks: np.ndarray  # TASK (B, N)
    agents: np.ndarray  # AGENT (B, A)
    pairs: np.ndarray  # PAIR (B, N, A)
    base: np.ndarray  # int64 (B, N, A), first-round mean durations, or INELIGIBLE
    curves: np.ndarray  # float64 (B, N, A, 6), zero for robots
    filters: np.ndarray  # FILTER (B, N, A), estimates of stochastic humans
    priors: np.ndarray  # FILTER (B,), filters that have seen nothing
    lags: np.ndarray  # int64 (B, N, N), as MurseInstance.lags
    near: np.ndarray  # bool (B, N, N), as MurseInstance.near
    order: np.ndarray  # int64 (B, N), tasks in dispatch order, the first `dispatched` of them hold
    private_memory: (
        np.ndarray
    )  # int64 (B, A, N, 2), start and finish of a taken task that an agent learned from a conflict, -1: not learned
    rounds: np.ndarray  # ROUND (B, R)
    executed: np.ndarray  # EXECUTED (B, R, N)


def new_state(batch: int, n_tasks: int, n_agents: int, n_rounds: int) -> State:
    """Zeroed arrays of those sizes."""
    return State(
        rows=np.zeros(batch, ROW),
        tasks=np.zeros((batch, n_tasks), TASK),
        agents=np.zeros((batch, n_agents), AGENT),
        pairs=np.zeros((batch, n_tasks, n_agents), PAIR),
        base=np.zeros((batch, n_tasks, n_agents), np.int64),
        curves=np.zeros((batch, n_tasks, n_agents, 6)),
        filters=np.zeros((batch, n_tasks, n_agents), FILTER),
        priors=np.zeros(batch, FILTER),
        lags=np.full((batch, n_tasks, n_tasks), -1, np.int64),
        near=np.zeros((batch, n_tasks, n_tasks), np.bool_),
        order=np.zeros((batch, n_tasks), np.int64),
        private_memory=np.full((batch, n_agents, n_tasks, 2), -1, np.int64),
        rounds=np.zeros((batch, n_rounds), ROUND),
        executed=np.zeros((batch, n_rounds, n_tasks), EXECUTED),
    )


def load_instance(state: State, b: int, instance: MurseInstance, n_rounds: int) -> None:
    """Write an instance's data to row b, whose padding must be large enough; the episode is started elsewhere."""
    n, a, robots = instance.n_tasks, instance.n_agents, instance.n_robots
    row, tasks = state.rows[b], state.tasks[b]
    row["n_tasks"], row["n_agents"], row["n_robots"], row["n_rounds"] = n, a, robots, n_rounds
    row["learning"], row["stochastic"] = instance.learning_code, instance.durations == "stochastic"
    row["low"], row["high"] = instance.duration_range
    tasks[:] = 0
    tasks["x"][:n], tasks["y"][:n] = instance.locations.T
    tasks["weight"][:n], tasks["deadline"][:n] = instance.weights, instance.deadlines
    tasks["place"][:n] = np.unique(instance.locations, axis=0, return_inverse=True)[1].reshape(-1)
    state.base[b], state.curves[b] = INELIGIBLE, 0.0
    state.pairs["true"][b] = state.pairs["planned"][b] = INELIGIBLE
    state.base[b, :n, :a] = instance.mean_durations
    state.curves[b, :n, robots:a] = instance.curves
    state.lags[b], state.near[b] = -1, False
    state.lags[b, :n, :n], state.near[b, :n, :n] = instance.lags, instance.near
    if row["stochastic"] and instance.n_humans:
        state.priors[b] = new_filters(prior_of(instance.identity, instance.duration_range), ())


@lru_cache(maxsize=65536)
def prior_of(identity: int, duration_range: tuple[int, int]) -> Prior:
    """The prior of an instance's humans, from a population of its own (section 5.7.3)."""
    low, high = duration_range
    return population_prior(np.random.default_rng([identity]), (min(2.0 * low, float(high)), float(high)))

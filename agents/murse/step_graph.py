"""The graph of a schedule under construction in which a task is chosen next (dissertation, section 4.3.1).

Task nodes are the placeholders s0 and f0, then the tasks; `temporal` is the simplified minimum distance graph, complete
and directed. The value nodes of algorithm 2 are the decision nodes of marl_sched.graph, one for each task node; the
action mask names those that may be chosen, each for an agent.

Not as published (where durations and distances stand as they are): times are divided by the round's horizon, the larger
of mean load and latest deadline, or by the mean duration; a task carries its latest start, slack, tail, and what taking
it now would break; edges say whether two tasks are near each other; s0 and f0 are not among any agent's tasks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marl_sched.agents.murse import latest_start as lst
from marl_sched.agents.murse.backward import backward_starts, latest_finishes
from marl_sched.agents.murse.partial_schedule import PartialSchedule
from marl_sched.agents.murse.problem import Round
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.network import END, ORIGIN, start_point
from marl_sched.graph import ACTION_MASK, DECISION, STATE, Feature, Features, GraphSpec, NodeType, Relation
from marl_sched.kernels import kernel

PLACEHOLDERS = 2  # s0 and f0 stand before the tasks
TASK = Features(
    *(Feature(name) for name in (
        "placeholder", "open", "running", "candidate",
        "duration", "min_duration", "duration_range", "mean_duration", "duration_std", "regret",
        "until_start", "until_start/horizon", "latest_start", "latest_start/horizon", "rule_start/horizon",
        "backward_start", "backward_start/horizon", "rank", "candidate_rank", "dated",
        "tail", "tail/horizon", "waiting", "near_open", "near_work", "broken", "pressed", "lateness", "weight",
    ))
)  # fmt: skip
AGENT = Features(
    *(Feature(name) for name in ("picked", "free", "until_free", "until_free/horizon", "load", "tasks", "open_mean"))
)
PLACE = Features(*(Feature(name) for name in ("open", "work", "work/horizon", "until_free")))
STATE_FEATURES = ("open", "tasks/100", "agents/10", "free", "candidates", "time", "load_left", "least_slack")
TEMPORAL = ("distance", "distance/horizon", "near")
_FAR, _CLOSE = 2.0, 6.0  # where times over the horizon and over the mean duration are cut off


def _relation(source: str, name: str, target: str, attributes: tuple[str, ...] = ()) -> Relation:
    return Relation(source, name, target, "dense", attention=True, attributes=attributes)


SPEC = GraphSpec(
    nodes=(NodeType("task", TASK.labels), NodeType("agent", AGENT.labels), NodeType("place", PLACE.labels)),
    state_features=STATE_FEATURES,
    relations=(
        _relation("task", "temporal", "task", TEMPORAL),
        Relation("task", "located_in", "place", "scatter", attention=True, index="location"),
        _relation("place", "near", "place"),
        Relation("place", "holds", "task", "gather", index="location"),
        _relation("task", "assigned_to", "agent"),
        _relation("task", "take_time", "agent", ("duration", "regret")),
        _relation("agent", "use_time", "task", ("duration", "regret")),
        Relation("agent", "com", "agent", "all", attention=True),
        *(Relation(source, "in", STATE, "all") for source in ("task", "place", "agent")),
        Relation("task", "to", DECISION, "same"),
        Relation("agent", "to", DECISION, "gather", index="decider"),
        Relation(STATE, "to", DECISION, "all"),
    ),
    decision_of="task",
)


@dataclass(frozen=True, eq=False)
class RoundFacts:
    """What does not change while a round is scheduled.

    Attributes:
        problem: the round.
        places: int64 (N,), the place of each task, counted from 0.
        near_places: bool (L, L), places whose tasks must not overlap, each near itself.
        horizon: the larger of mean load and latest deadline.
        unit: the mean duration.
        rule_starts: float64 (N,), keys of the rule `lst`.
        ends: float64 (N,), latest finishes; without a deadline behind a task, late enough to press nobody.
        dated: bool (N,), tasks with a deadline at or behind them.
        waiting: the tasks that wait for each, as `latest_start.successors` gives them.
        shortest: int64 (N,), least durations.
    """

    problem: Round
    places: np.ndarray
    near_places: np.ndarray
    horizon: float
    unit: float
    rule_starts: np.ndarray
    ends: np.ndarray
    dated: np.ndarray
    waiting: tuple[np.ndarray, np.ndarray, np.ndarray]
    shortest: np.ndarray

    @classmethod
    def of(cls, instance: MurseInstance, problem: Round | None = None) -> RoundFacts:
        """Those of an instance's round, by default of its first on mean durations."""
        problem = Round.of(instance) if problem is None else problem
        able = problem.eligible
        means = np.where(able, problem.durations, 0).sum(1) / able.sum(1)
        load = means.sum() / problem.n_agents
        horizon = float(max(load, problem.deadlines.max(), 1.0))
        positions, places = np.unique(instance.locations, axis=0, return_inverse=True)
        apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
        reach = {"distance": instance.safety_distance, "location": 0.0, "none": -1.0}[instance.proximity]
        ends, dated = latest_finishes(problem)
        rule = lst.common_horizon(problem.durations)
        return cls(
            problem=problem,
            places=places.reshape(-1).astype(np.int64),
            near_places=(apart <= reach) | np.eye(len(positions), dtype=bool),
            horizon=horizon,
            unit=float(max(means.mean(), 1.0)),
            rule_starts=lst.latest_starts(problem.durations, problem.lags, problem.deadlines, rule),
            ends=ends,
            dated=dated,
            waiting=lst.successors(problem.lags),
            shortest=lst.shortest_durations(problem.durations),
        )


@kernel
def write_pairs(
    durations: np.ndarray,
    distances: np.ndarray,
    still_open: np.ndarray,
    doers: np.ndarray,
    free_at: np.ndarray,
    choices: np.ndarray,
    now: int,
    unit: float,
    tasks: np.ndarray,
    regrets: np.ndarray,
) -> None:
    """Write what durations say: features 0 to 9 of tasks, float32 (N + 2, TASK), and regrets float32 (A, N).

    choices int64 (N,) are the agents for whom tasks may be chosen, -1 for other tasks. A regret is how much later than
    the best agent one finishes a task. Both are zeroed before.
    """
    n, m = durations.shape
    tasks[0, 0] = tasks[1, 0] = 1.0
    for i in range(n):
        row, earliest = tasks[i + 2], -distances[start_point(i), ORIGIN]
        if not still_open[i]:
            row[2] = earliest + durations[i, doers[i]] > now
            row[4] = row[5] = row[7] = durations[i, doers[i]] / unit
            continue
        able, total, squares, least, most, best = 0, 0.0, 0.0, 1e18, 0.0, 1e18
        for a in range(m):
            lasts = durations[i, a]
            if lasts >= 0:
                able, total, squares = able + 1, total + lasts, squares + lasts * lasts
                least, most = min(least, lasts), max(most, lasts)
                best = min(best, max(now, earliest, free_at[a]) + lasts)
        for a in range(m):
            if durations[i, a] >= 0:
                regrets[a, i] = min((max(now, earliest, free_at[a]) + durations[i, a] - best) / unit, _CLOSE) / 2
        mean = total / able
        row[1], row[4] = 1.0, mean / unit
        row[5], row[6], row[7] = least / unit, (most - least) / unit, mean / unit
        row[8] = np.sqrt(max(squares / able - mean * mean, 0.0)) / unit
        if choices[i] >= 0:
            row[3], row[4], row[9] = 1.0, durations[i, choices[i]] / unit, regrets[choices[i], i]


@kernel
def write_times(
    distances: np.ndarray,
    still_open: np.ndarray,
    backward: np.ndarray,
    rule_starts: np.ndarray,
    free_at: np.ndarray,
    choices: np.ndarray,
    now: int,
    constants: tuple[float, float],
    tasks: np.ndarray,
) -> None:
    """Write what the network says: features 10 to 18, 20 and 21 of tasks; `constants` are horizon and unit."""
    horizon, unit = constants
    n_open, n_candidates = max(still_open.sum(), 1), max((choices >= 0).sum(), 1)
    for i in range(len(still_open)):
        row = tasks[i + 2]
        to_start = -distances[start_point(i), ORIGIN] - now
        if choices[i] >= 0:
            to_start = max(to_start, free_at[choices[i]] - now, 0)
        row[10] = min(max(to_start / unit, -_CLOSE), _CLOSE) / 2
        if not still_open[i]:
            continue
        slack = distances[ORIGIN, start_point(i)] - now
        row[11] = min(to_start / horizon, _FAR)
        row[12], row[13] = min(max(slack / unit, -_CLOSE), _CLOSE) / 2, min(max(slack / horizon, -_FAR), _FAR)
        row[14] = min(max((rule_starts[i] - now) / horizon, -_FAR), _FAR)
        row[15] = min(max((backward[i] - now) / unit, -_CLOSE), _CLOSE) / 2
        row[16] = min(max((backward[i] - now) / horizon, -_FAR), _FAR)
        before, before_here = 0, 0
        for k in range(len(still_open)):
            if still_open[k] and backward[k] < backward[i]:
                before += 1
                before_here += choices[k] >= 0
        row[17], row[18] = before / n_open, before_here / n_candidates
        tail = -distances[END, start_point(i)]
        row[20], row[21] = min(tail / unit, 2 * _CLOSE) / 4, tail / horizon


@kernel
def write_neighbours(
    durations: np.ndarray,
    near: np.ndarray,
    distances: np.ndarray,
    still_open: np.ndarray,
    backward: np.ndarray,
    free_at: np.ndarray,
    choices: np.ndarray,
    now: int,
    constants: tuple[float, float],
    shortest: np.ndarray,
    tasks: np.ndarray,
) -> None:
    """Write what open tasks that are near would suffer if a task were chosen: features 23 to 27."""
    horizon, unit = constants
    for i in range(len(still_open)):
        if not still_open[i]:
            continue
        row, worst = tasks[i + 2], -_CLOSE
        ends = max(now, -distances[start_point(i), ORIGIN])
        if choices[i] >= 0:
            ends = max(ends, free_at[choices[i]]) + durations[i, choices[i]]
        else:
            ends += shortest[i]
        for k in range(len(still_open)):
            if near[i, k] and still_open[k]:
                row[23] += 0.1
                row[24] += shortest[k] / horizon
                row[25] += 0.2 * (distances[ORIGIN, start_point(k)] < ends)
                row[26] += 0.2 * (backward[k] < ends)
                worst = max(worst, (ends - backward[k]) / unit)
        row[27] = min(worst, _CLOSE) / 2


@kernel
def write_edges(distances: np.ndarray, near: np.ndarray, constants: tuple[float, float], temporal: np.ndarray) -> None:
    """Write the attributes TEMPORAL, float32 (N + 2, N + 2, 3), of the edges from the second point to the first."""
    horizon, unit = constants
    n = len(near)
    points = np.empty(n + 2, np.int64)
    points[0], points[1] = ORIGIN, END
    for i in range(n):
        points[i + 2] = start_point(i)
    for target in range(n + 2):
        for source in range(n + 2):
            apart = distances[points[source], points[target]]
            temporal[target, source, 0] = min(max(apart / unit, -_CLOSE), _CLOSE) / 2
            temporal[target, source, 1] = min(max(apart / horizon, -_FAR), _FAR)
            if target > 1 and source > 1:
                temporal[target, source, 2] = near[target - 2, source - 2]


class StepGraphs:
    """Arrays of a batch of graphs, see marl_sched.graph, padded to the largest round.

    Args:
        facts: of the rounds that may stand in it.
        count: graphs.
    """

    def __init__(self, facts: list[RoundFacts], count: int) -> None:
        sizes = {
            "task": PLACEHOLDERS + max(one.problem.n_tasks for one in facts),
            "agent": max(one.problem.n_agents for one in facts),
            "place": max(len(one.near_places) for one in facts),
        }
        sizes[DECISION] = sizes["task"]
        self.arrays = {name: array.empty(count) for name, array in SPEC.arrays(sizes).items()}

    def write(self, at: int, facts: RoundFacts, schedule: PartialSchedule, choices: np.ndarray, now: int) -> None:
        """Write the graph of a choice at time `now` between tasks i for agents choices[i], int64 (N,), -1 for none."""
        arrays = {name: array[at] for name, array in self.arrays.items() if array.ndim > 1}
        for array in arrays.values():
            array[...] = 0
        problem, n, m = facts.problem, facts.problem.n_tasks, facts.problem.n_agents
        constants, still_open = (facts.horizon, facts.unit), schedule.still_open
        backward = backward_starts(problem.durations, facts.waiting, problem.lags, problem.near, still_open, facts.ends)
        tasks, end = arrays["task"], PLACEHOLDERS + n
        regrets = np.zeros((m, n), np.float32)
        write_pairs(
            problem.durations, schedule.distances, still_open, schedule.doers, schedule.free_at, choices, now,
            facts.unit, tasks, regrets,
        )  # fmt: skip
        write_times(
            schedule.distances, still_open, backward, facts.rule_starts, schedule.free_at, choices, now, constants,
            tasks,
        )  # fmt: skip
        write_neighbours(
            problem.durations, problem.near, schedule.distances, still_open, backward, schedule.free_at, choices, now,
            constants, facts.shortest, tasks,
        )  # fmt: skip
        tasks[PLACEHOLDERS:end, TASK.index("dated")] = facts.dated & still_open
        tasks[PLACEHOLDERS:end, TASK.index("waiting")] = np.diff(facts.waiting[0]) / 3
        tasks[PLACEHOLDERS:end, TASK.index("weight")] = problem.weights / max(problem.weights.mean(), 1e-9)
        arrays[ACTION_MASK][PLACEHOLDERS:end] = choices >= 0
        arrays["task_mask"][: PLACEHOLDERS + n] = 1
        arrays["temporal"][: PLACEHOLDERS + n, : PLACEHOLDERS + n] = 1
        write_edges(schedule.distances, problem.near, constants, arrays["temporal_attributes"])
        self._write_agents(arrays, facts, schedule, choices, now, regrets)
        self._write_places(arrays, facts, schedule, now)
        least = (backward - now)[still_open].min(initial=facts.horizon) / facts.unit
        arrays[STATE][...] = (
            still_open.mean(), n / 100, m / 10, (schedule.free_at <= now).mean(), (choices >= 0).sum() / 10,
            now / facts.horizon, facts.shortest[still_open].sum() / m / facts.horizon,
            np.clip(least, -_CLOSE, _CLOSE) / 2,
        )  # fmt: skip

    @staticmethod
    def _write_agents(
        arrays: dict[str, np.ndarray],
        facts: RoundFacts,
        schedule: PartialSchedule,
        choices: np.ndarray,
        now: int,
        regrets: np.ndarray,
    ) -> None:
        problem, still_open = facts.problem, schedule.still_open
        n, m, end = problem.n_tasks, problem.n_agents, PLACEHOLDERS + problem.n_tasks
        until = np.maximum(schedule.free_at - now, 0)
        own = np.bincount(schedule.doers[~still_open], minlength=m)
        able = problem.eligible & still_open[:, None]
        mean = np.where(able, problem.durations, 0).sum(0) / np.maximum(able.sum(0), 1)
        arrays["agent_mask"][:m] = 1
        arrays["agent"][:m] = np.stack(
            [np.isin(np.arange(m), choices), until == 0, np.minimum(until / facts.unit, _CLOSE) / 2,
             until / facts.horizon, schedule.free_at / facts.horizon, own * m / n, mean / facts.unit], axis=1,
        )  # fmt: skip
        arrays["decider"][...] = -1
        arrays["decider"][PLACEHOLDERS:end] = choices
        arrays["assigned_to"][:m, PLACEHOLDERS:end] = schedule.doers == np.arange(m)[:, None]
        pairs = np.stack([problem.durations.T / facts.unit, regrets], axis=-1) * able.T[..., None]
        arrays["take_time"][:m, PLACEHOLDERS:end], arrays["take_time_attributes"][:m, PLACEHOLDERS:end] = able.T, pairs
        arrays["use_time"][PLACEHOLDERS:end, :m] = able
        arrays["use_time_attributes"][PLACEHOLDERS:end, :m] = pairs.transpose(1, 0, 2)

    @staticmethod
    def _write_places(arrays: dict[str, np.ndarray], facts: RoundFacts, schedule: PartialSchedule, now: int) -> None:
        problem, still_open, count = facts.problem, schedule.still_open, len(facts.near_places)
        open_at = np.bincount(facts.places[still_open], minlength=count)
        work = np.bincount(facts.places[still_open], weights=facts.shortest[still_open], minlength=count)
        done, until = np.flatnonzero(~still_open), np.zeros(count)
        finishes = schedule.earliest[done] + problem.durations[done, schedule.doers[done]]
        np.maximum.at(until, facts.places[done], finishes - now)
        arrays["place_mask"][:count] = 1
        arrays["place"][:count] = np.stack(
            [open_at * count / problem.n_tasks, np.minimum(work / facts.unit, 20) / 10, work / facts.horizon,
             np.minimum(until / facts.unit, _CLOSE) / 2], axis=1,
        )  # fmt: skip
        arrays["location"][...] = -1
        arrays["location"][PLACEHOLDERS : PLACEHOLDERS + problem.n_tasks] = facts.places
        arrays["near"][:count, :count] = facts.near_places

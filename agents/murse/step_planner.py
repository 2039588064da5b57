"""Schedules built step by step by a network that says what the tasks are worth that can be started next.

Scheduling through simulation (dissertation, algorithm 1): at the first time at which a free agent can start an open
task, one of the free agents is picked, and takes the startable task of the greatest worth, without asking the network
where there is only one. Four strategies pick agents; the `ensemble` keeps the best of their schedules. Schedules of
many rounds and strategies are built in lock-step, with one forward pass for all of them.

An agent that may not wait cannot leave a task to another one that would finish it sooner. The strategy `active`, which
is not published, offers the choices of an active schedule (Giffler and Thompson 1960) instead: every task for the agent
that would finish it earliest, unless it would start only after another one could have finished.

Beyond what is published, a task after which the network of what is left cannot be consistent is passed over for the
next best (`look_ahead`); published, the attempt has failed then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from marl_sched.agents.base import EpochPlayer
from marl_sched.agents.murse.following import PlanningScheduler
from marl_sched.agents.murse.partial_schedule import PartialSchedule
from marl_sched.agents.murse.problem import Plan, plan_cost
from marl_sched.agents.murse.snapshot import as_murse, estimated_round
from marl_sched.agents.murse.step_graph import PLACEHOLDERS, RoundFacts, StepGraphs
from marl_sched.agents.murse.whole_rounds import round_player
from marl_sched.agents.networks.planner import TrainedPlanner
from marl_sched.agents.policies.cards import PolicyCard
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.errors import InvalidOptionError
from marl_sched.kernels import kernel
from marl_sched.simulation import TurnSimulator
from marl_sched.temporal_network import UNBOUNDED

Strategy = Literal["first", "mean_open", "least_open", "mean_startable", "active"]
PUBLISHED: tuple[Strategy, ...] = ("first", "mean_open", "least_open", "mean_startable")
ENSEMBLE = "ensemble"
Worths = Callable[[dict[str, np.ndarray]], np.ndarray]
"""From the arrays of K graphs (marl_sched.agents.murse.step_graph) to worths of task nodes, float (K, tasks + 2)."""
_EDGES_AT_ONCE = 1_500_000  # of a forward pass


def pick_agent(schedule: PartialSchedule, strategy: Strategy, now: int) -> int:
    """The free agent that chooses at `now`, ties to the lower index (section 4.2.2).

    `first` takes the first; the others the one of the least mean duration of open tasks (`mean_open`), least duration
    of any open task (`least_open`), or least mean duration of the tasks that it can start now (`mean_startable`, as in
    the published code, where the text has all tasks). Agents that can start nothing are not picked.
    """
    durations, eligible = schedule.problem.durations, schedule.problem.eligible
    startable = schedule.startable(now)
    free = np.flatnonzero((schedule.free_at <= now) & (eligible & startable[:, None]).any(0))
    if strategy == "first" or len(free) == 1:
        return int(free[0])
    among = eligible[:, free] & (startable if strategy == "mean_startable" else schedule.still_open)[:, None]
    if strategy == "least_open":
        return int(free[np.where(among, durations[:, free], np.inf).min(0).argmin()])
    means = np.where(among, durations[:, free], 0).sum(0) / among.sum(0)
    return int(free[means.argmin()])


@kernel
def active_choices(
    durations: np.ndarray, earliest: np.ndarray, still_open: np.ndarray, free_at: np.ndarray
) -> tuple[np.ndarray, int]:
    """The agents, int64 (N,), for whom tasks may be chosen in an active schedule, else -1, and the first start of all.

    durations int64 (N, A), earliest int64 (N,), still_open bool (N,), free_at int64 (A,). Ties of agents go to the one
    that has been free for a shorter time, then to the lower index.
    """
    n, m = durations.shape
    choices, starts, least, first = np.full(n, -1, np.int64), np.zeros(n, np.int64), UNBOUNDED, UNBOUNDED
    for task in range(n):
        end = UNBOUNDED
        for agent in range(m):
            if still_open[task] and durations[task, agent] >= 0:
                start = max(earliest[task], free_at[agent])
                ends = start + durations[task, agent]
                if ends < end or (ends == end and free_at[agent] > free_at[choices[task]]):
                    choices[task], starts[task], end = agent, start, ends
        if choices[task] >= 0:
            least, first = min(least, end), min(first, starts[task])
    for task in range(n):
        if choices[task] >= 0 and starts[task] >= least and starts[task] + durations[task, choices[task]] > least:
            choices[task] = -1
    return choices, first


def choices_at(schedule: PartialSchedule, strategy: Strategy) -> tuple[np.ndarray, int]:
    """The agents for whom tasks may be chosen next, int64 (N,), -1 for other tasks, and the time of the choice.

    By the published strategies all of them are the one agent that was picked.
    """
    if strategy == "active":
        found, first = active_choices(
            schedule.problem.durations, schedule.earliest, schedule.still_open, schedule.free_at
        )
        return found, int(first)
    now = schedule.now
    agent = pick_agent(schedule, strategy, now)
    return np.where(schedule.startable(now, agent), agent, -1), now


@dataclass(eq=False)
class Attempt:
    """One schedule under construction, and who chooses in it next."""

    number: int
    facts: RoundFacts
    strategy: Strategy
    schedule: PartialSchedule
    choices: np.ndarray
    now: int = 0

    def advance(self) -> bool:
        """Go on to the next choice between several tasks; False where there is none any more."""
        schedule = self.schedule
        while schedule.consistent and not schedule.complete:
            self.choices, self.now = choices_at(schedule, self.strategy)
            offered = np.flatnonzero(self.choices >= 0)
            if len(offered) > 1:
                return True
            self._append(schedule, int(offered[0]))
        return False

    def _append(self, schedule: PartialSchedule, task: int) -> bool:
        return schedule.append(task, int(self.choices[task]), in_order=self.strategy != "active")

    def take(self, worths: np.ndarray, *, look_ahead: bool) -> None:
        """Take the task of the greatest worth, float (N or more,), among those offered, see the module's page."""
        ranked = [
            task for task in np.argsort(-worths[: len(self.choices)], kind="stable").tolist() if self.choices[task] >= 0
        ]
        for task in ranked if look_ahead else ():
            trial = self.schedule.copy()
            if self._append(trial, task):
                self.schedule = trial
                return
        self._append(self.schedule, ranked[0])


def attempts_of(rounds: Sequence[RoundFacts], strategies: Sequence[Strategy]) -> list[Attempt]:
    """An empty schedule for every round and strategy, in this order."""
    starts = [PartialSchedule.of(facts.problem) for facts in rounds]
    return [
        Attempt(number, facts, strategy, starts[number].copy(), np.empty(0, np.int64))
        for number, facts in enumerate(rounds)
        for strategy in strategies
    ]


def build(
    attempts: Sequence[Attempt], worths: Worths, chosen: Callable[[list[Attempt], StepGraphs, np.ndarray], None]
) -> None:
    """Build schedules in lock-step: `chosen(attempts, graphs, worths)` takes the next step of a block of them."""
    going = [attempt for attempt in attempts if attempt.advance()]
    while going:
        for block in _blocks(going):
            graphs = StepGraphs([attempt.facts for attempt in block], len(block))
            for k, attempt in enumerate(block):
                graphs.write(k, attempt.facts, attempt.schedule, attempt.choices, attempt.now)
            chosen(block, graphs, worths(graphs.arrays)[:, PLACEHOLDERS:])
        going = [attempt for attempt in going if attempt.advance()]


def build_plans(
    rounds: Sequence[RoundFacts],
    strategies: Sequence[Strategy],
    worths: Worths,
    *,
    objective: str = "makespan",
    look_ahead: bool = True,
) -> list[Plan]:
    """The best plan of each round over the strategies, by feasibility and then by the objective; ties to the first.

    A plan that is not feasible has the tasks that were scheduled until the attempt had failed.
    """

    def greedily(block: list[Attempt], graphs: StepGraphs, found: np.ndarray) -> None:
        for attempt, values in zip(block, found, strict=True):
            attempt.take(values, look_ahead=look_ahead)

    attempts = attempts_of(rounds, strategies)
    build(attempts, worths, greedily)
    best: list[Plan | None] = [None] * len(rounds)
    for attempt in attempts:
        plan, before = attempt.schedule.plan(), best[attempt.number]
        problem = attempt.facts.problem
        if before is None or plan_cost(problem, plan, objective) < plan_cost(problem, before, objective):
            best[attempt.number] = plan
    return [plan for plan in best if plan is not None]


def _blocks(attempts: list[Attempt]) -> list[list[Attempt]]:
    """Attempts of about the same size, so many that their edges fit into one pass."""
    ordered = sorted(attempts, key=lambda attempt: attempt.facts.problem.n_tasks)
    blocks: list[list[Attempt]] = [[]]
    for attempt in ordered:
        edges = (attempt.facts.problem.n_tasks + PLACEHOLDERS) ** 2
        if blocks[-1] and edges * (len(blocks[-1]) + 1) > _EDGES_AT_ONCE:
            blocks.append([])
        blocks[-1].append(attempt)
    return blocks


class StepPlanner(PlanningScheduler, TrainedPlanner):
    """Plans a round by a network's worths.

    Args:
        worths: of the tasks that an agent can start.
        name: as users type it.
        card: what the network is.
        strategy: one of them, or `ensemble` for the best of the four published ones.
        look_ahead: see the module's page.

    Raises InvalidOptionError for another strategy.
    """

    def __init__(
        self,
        worths: Worths,
        name: str,
        card: PolicyCard | None = None,
        *,
        strategy: str = "active",
        look_ahead: bool = True,
    ) -> None:
        super().__init__()
        known = {one: (one,) for one in get_args(Strategy)} | {ENSEMBLE: PUBLISHED}
        if strategy not in known:
            raise InvalidOptionError(f"{name}: strategy: expected one of {', '.join(known)}, got {strategy!r}")
        self.name, self.card, self._worths, self._look_ahead = name, card, worths, look_ahead
        self._strategies: tuple[Strategy, ...] = known[strategy]

    def plan(self, simulator: MurseSimulator, env_index: int) -> Plan:
        """The plan of a row's round on the durations that the team counts on."""
        return self._together(simulator, [env_index])[0]

    def _together(self, simulator: MurseSimulator, rows: Sequence[int]) -> list[Plan]:
        rounds = [RoundFacts.of(simulator.instances[row], estimated_round(simulator, row)) for row in rows]
        return build_plans(
            rounds, self._strategies, self._worths, objective=simulator.objective, look_ahead=self._look_ahead
        )

    def epoch_player(self, simulator: TurnSimulator) -> EpochPlayer | None:
        """Plays whole rounds, planned for all rows together; None where turns have to be taken."""
        murse = as_murse(simulator)
        if round_player(murse, self.plan) is None:
            return None

        def play(count: int) -> tuple[float, int]:
            rows = np.flatnonzero(murse.acting != NOBODY).tolist()
            plans = self._together(murse, rows)
            for row, plan in zip(rows, plans, strict=True):
                murse.play_round(row, plan.tasks, plan.agents)
            decisions = sum(len(plan.tasks) for plan in plans)
            return float(decisions), decisions

        return play

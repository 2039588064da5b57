"""What networks learn that build schedules step by step: an expert's steps, or what their own steps would cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from marl_sched.agents.murse.backward import backward_starts
from marl_sched.agents.murse.latest_start import complete
from marl_sched.agents.murse.partial_schedule import PartialSchedule
from marl_sched.agents.murse.problem import Round, timed
from marl_sched.agents.murse.sampling import dispatched
from marl_sched.agents.murse.snapshot import as_murse
from marl_sched.agents.murse.step_graph import PLACEHOLDERS, TASK, RoundFacts, StepGraphs
from marl_sched.agents.murse.step_planner import PUBLISHED, Attempt, Worths, attempts_of, build, choices_at
from marl_sched.envs.murse.instance import NO_DEADLINE, MurseInstance
from marl_sched.kernels import kernel
from marl_sched.simulation import TurnSimulator

LATE_CHARGE = 2.0  # of a unit of lateness, in units of makespan
INFEASIBLE_CHARGE = 0.5  # of any lateness at all, as a share of the makespan
TIGHT_CHARGE = 0.1  # of a unit by which a task ends less than the mean duration before its deadline
COMPACT_CHARGE = 0.05  # of the mean finish of tasks: what tells schedules of the same makespan apart
RULE_CHARGE = 0.01  # of the last candidate by the rule, as a share of the cost: what tells equal costs apart
NOISE = 0.5
PUBLISHED_EVERY = 4  # instances
_PARTS = 3.0  # by which the reward of all steps but the last is divided (D in section 3.4.1)


def played_schedule(simulator: TurnSimulator, row: int) -> np.ndarray:
    """Tasks, agents and starts of the first round that a row has played, int64 (3, N), by start, finish and agent.

    N = 0 where that was not feasible.
    """
    murse = as_murse(simulator)
    problem = Round.of(murse.instances[row])
    plan = timed(problem, *dispatched(murse, row, 0))
    if not plan.feasible:
        return np.zeros((3, 0), np.int64)
    starts, finishes = plan.starts[plan.tasks], plan.finishes[plan.tasks]
    order = np.lexsort((plan.agents, finishes, starts))
    return np.stack([plan.tasks[order], plan.agents[order], starts[order]])


def steps_of(instance: MurseInstance, schedule: np.ndarray, discount: float) -> dict[str, np.ndarray]:
    """The steps of a schedule, int64 (3, N) as `played_schedule` gives it, at which there was a choice.

    Each step is taken once as the published strategies offer it, for the agent that the schedule has, and once as
    `active` does, where that offers it. The arrays of their graphs with a leading axis K, `label` int64 (K,), the slot
    of the task that it took, and `return` float64 (K,): the discounted rewards from there on in units of the horizon,
    which add up to minus the makespan (section 3.4.1).
    """
    facts, graphs = RoundFacts.of(instance), StepGraphs([RoundFacts.of(instance)], 2 * schedule.shape[1])
    picked, active, makespans = PartialSchedule.of(facts.problem), PartialSchedule.of(facts.problem), [0]
    labels: list[int] = []
    places: list[int] = []
    for place, (task, agent, start) in enumerate(schedule.T.tolist()):
        offers = (
            (picked, np.where(picked.startable(start, agent), agent, -1), start),
            (active, *choices_at(active, "active")),
        )
        for partial, choices, now in offers:
            if (choices >= 0).sum() > 1 and _offers(facts.problem, choices, task, agent):
                graphs.write(len(labels), facts, partial, choices, now)
                labels.append(task + PLACEHOLDERS)
                places.append(place)
        picked.append(task, agent)
        active.append(task, agent, in_order=False)
        makespans.append(active.makespan)
    rewards = -np.diff(makespans) / _PARTS
    rewards[-1:] = -(makespans[-1] - makespans[-2] / _PARTS)
    returns, ahead = np.zeros(len(rewards)), 0.0
    for place in range(len(rewards) - 1, -1, -1):
        ahead = returns[place] = rewards[place] / facts.horizon + discount * ahead
    arrays = {name: array[: len(labels)] for name, array in graphs.arrays.items()}
    return {**arrays, "label": np.array(labels, np.int64), "return": returns[places]}


def _offers(problem: Round, choices: np.ndarray, task: int, agent: int) -> bool:
    """Whether a task is among the choices for this agent, or for one that takes as long for it."""
    other = int(choices[task])
    return other >= 0 and bool(problem.durations[task, other] == problem.durations[task, agent])


def gathered_steps(
    steps: Sequence[dict[str, np.ndarray]], padding: Mapping[str, float] | None = None
) -> dict[str, np.ndarray]:
    """Steps one behind the other, padded to the largest graph with zeros or with what `padding` says."""
    out: dict[str, np.ndarray] = {}
    for name, first in steps[0].items():
        parts = [each[name] for each in steps]
        shape = np.max([part.shape[1:] for part in parts], axis=0).astype(int) if first.ndim > 1 else ()
        joined = np.full((sum(map(len, parts)), *shape), (padding or {}).get(name, 0), first.dtype)
        at = 0
        for part in parts:
            joined[(slice(at, at + len(part)), *map(slice, part.shape[1:]))] = part
            at += len(part)
        out[name] = joined
    return out


@kernel
def completion_costs(
    durations: np.ndarray,
    waiting: tuple[np.ndarray, np.ndarray, np.ndarray],
    near: np.ndarray,
    deadlines: np.ndarray,
    unit: float,
    order: np.ndarray,
    count: int,
    doers: np.ndarray,
    start: np.ndarray,
    finish: np.ndarray,
    free_at: np.ndarray,
    earliest: np.ndarray,
    choices: np.ndarray,
    keys: np.ndarray,
) -> np.ndarray:
    """What a schedule costs if a task is dispatched next and the rest follows by keys, float64 (N,).

    The first `count` of `order` int64 (N,) are dispatched (see `latest_start.complete`, as for the other arrays);
    earliest int64 (N,) are earliest starts; choices int64 (N,) the agents of tasks that may come next, -1 for others,
    which cost inf; keys float64 (L, N), of which the best counts. A cost is the makespan, plus LATE_CHARGE of the sum
    of lateness, INFEASIBLE_CHARGE of the makespan if anything is late, TIGHT_CHARGE of what lacks for every task to end
    `unit` before its deadline, and COMPACT_CHARGE of the mean finish.
    """
    n = len(choices)
    costs = np.full(n, np.inf)
    for task in range(n):
        agent = choices[task]
        if agent < 0:
            continue
        for way in range(len(keys)):
            then, who, begin, end, ready = order.copy(), doers.copy(), start.copy(), finish.copy(), free_at.copy()
            begin[task] = max(earliest[task], free_at[agent])
            end[task] = begin[task] + durations[task, agent]
            then[count], who[task], ready[agent] = task, agent, end[task]
            complete(durations, waiting, near, keys[way], ready, then, count + 1, who, begin, end)
            late, tight = 0, 0.0
            for other in range(n):
                if deadlines[other] != NO_DEADLINE:
                    late += max(end[other] - deadlines[other], 0)
                    tight += max(end[other] + unit - deadlines[other], 0.0)
            last = end.max()
            cost = last * (1.0 + (INFEASIBLE_CHARGE if late > 0 else 0.0)) + LATE_CHARGE * late
            costs[task] = min(costs[task], cost + TIGHT_CHARGE * tight + COMPACT_CHARGE * end.mean())
    return costs


def step_costs(attempt: Attempt) -> np.ndarray:
    """What the choices of an attempt's next step cost, float64 (N,), completed by latest starts of two kinds.

    Those are the rule `lst` and `backward_starts`.
    """
    facts, schedule = attempt.facts, attempt.schedule
    problem = facts.problem
    order, done = np.zeros(problem.n_tasks, np.int64), [task for task, _ in schedule.order]
    order[: len(done)] = done
    start = schedule.earliest
    finish = np.where(schedule.still_open, 0, start + problem.durations[np.arange(problem.n_tasks), schedule.doers])
    backward = backward_starts(
        problem.durations, facts.waiting, problem.lags, problem.near, schedule.still_open, facts.ends
    )
    costs: np.ndarray = completion_costs(
        problem.durations, facts.waiting, problem.near, problem.deadlines, facts.unit, order, len(done),
        schedule.doers, start, finish, schedule.free_at, start, attempt.choices,
        np.stack([backward, facts.rule_starts]),
    )  # fmt: skip
    return costs


def explored_steps(
    instances: Sequence[MurseInstance], worths: Worths, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """The steps with a choice of schedules that a network samples: of every instance by `active`, of some as published.

    The arrays of their graphs with a leading axis K, and `costs` float64 (K, N + 2): see `step_costs`, plus RULE_CHARGE
    for the rank by `backward_starts`. Tasks are drawn by Gumbel noise of NOISE on their worths; one after which the
    network is inconsistent is passed over for the next.
    """
    rounds = [RoundFacts.of(instance) for instance in instances]
    attempts = attempts_of(rounds, ("active",))
    for facts in rounds[::PUBLISHED_EVERY]:
        attempts += attempts_of([facts], (PUBLISHED[int(rng.integers(len(PUBLISHED)))],))
    steps: list[dict[str, np.ndarray]] = []

    def sampled(block: list[Attempt], graphs: StepGraphs, found: np.ndarray) -> None:
        costs = np.full((len(block), found.shape[1] + PLACEHOLDERS), np.inf)
        for k, attempt in enumerate(block):
            costs[k, PLACEHOLDERS : PLACEHOLDERS + attempt.facts.problem.n_tasks] = step_costs(attempt)
        ranks = graphs.arrays["task"][..., TASK.index("candidate_rank")]
        costs += RULE_CHARGE * costs.min(axis=1, keepdims=True) * ranks
        steps.append({**graphs.arrays, "costs": costs})
        noise = NOISE * rng.gumbel(size=found.shape)
        for attempt, values in zip(block, found + noise, strict=True):
            attempt.take(values, look_ahead=True)

    build(attempts, worths, sampled)
    return gathered_steps(steps, {"costs": np.inf})

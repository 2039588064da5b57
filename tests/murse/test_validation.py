"""The simulator against the validator, which shares no code with it, and the validator against broken schedules."""

from __future__ import annotations

import ast
import copy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_sched.envs.murse import validation
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.network import finish_point, start_point, task_network
from marl_sched.envs.murse.schedule import save_schedule, schedule
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.timetable import time_batch
from marl_sched.envs.murse.validation import validate
from marl_sched.envs.murse.views import LocalView
from marl_sched.errors import InvalidOptionError
from marl_sched.files import read_json
from marl_sched.temporal_network import close, relax
from tests.murse.problems import instances, play_randomly, played, three_tasks

modes = st.sampled_from(["plan", "online"])
seeds = st.integers(0, 9)


@given(instances(), modes, seeds, st.booleans())
@settings(max_examples=400)
def test_simulator_calls_feasible_exactly_what_the_validator_does(instance, mode, seed, local):
    view = LocalView(sensing=3.0, comm=2.0) if local else None
    simulator = MurseSimulator([instance] * 4, mode=mode, view=view)
    simulator.reset(seed=seed, episodes=[0, 1, 2, 3])
    play_randomly(simulator, seed)
    for row in range(4):
        for index in range(instance.n_rounds):
            data = schedule(simulator, row, index)
            verdict = validate(data)
            assert verdict.feasible == data["feasible"], verdict
            assert verdict.differing == []
            assert verdict.makespan == data["makespan"]
            assert (verdict.given_broken == []) == data["feasible"]


def random_orders(instance: MurseInstance, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Dispatch orders and agents, int64 (count, N) each, whatever the waits say."""
    rng = np.random.default_rng(seed)
    orders = np.array([rng.permutation(instance.n_tasks) for _ in range(count)])
    agents = np.array([[rng.choice(np.flatnonzero(instance.eligible[i])) for i in order] for order in orders])
    return orders, agents


def network_times(instance: MurseInstance, order: np.ndarray, agents: np.ndarray) -> np.ndarray | None:
    """Starts by closing the whole temporal network of a schedule, or None if it is inconsistent."""
    durations = np.array([instance.mean_durations[i, agents[list(order).index(i)]] for i in range(instance.n_tasks)])
    distances = task_network(durations, durations, instance.lags, np.full(instance.n_tasks, -1), 10_000)
    for k, later in enumerate(order):
        for m, earlier in enumerate(order[:k]):
            if agents[k] == agents[m] or instance.near[later, earlier]:
                relax(distances, start_point(later), finish_point(earlier), 0)
    return -distances[2::2, 0] if close(distances) else None


@given(instances(), seeds)
@settings(max_examples=200)
def test_any_dispatch_order_is_timed_as_its_temporal_network_and_the_validator_say(instance, seed):
    orders, agents = random_orders(instance, seed, 6)
    batch = time_batch(orders, agents, instance.mean_durations, instance.lags, instance.near, instance.deadlines)
    for order, team, starts, _, makespan, feasible in zip(orders, agents, *batch, strict=True):
        expected = network_times(instance, order, team)
        data = as_data(instance, order, team, starts)
        verdict = validate(data)
        assert verdict.feasible == feasible
        if expected is None:
            assert verdict.broken[-1] == "order: tasks must precede each other"
        else:
            assert starts.tolist() == expected.tolist()
            assert verdict.makespan == makespan


@given(instances(), seeds)
@settings(max_examples=100)
def test_a_whole_schedule_is_executed_as_it_is_timed(instance, seed):
    orders, agents = random_orders(instance, seed, 1)
    simulator = MurseSimulator([instance], durations="deterministic")
    simulator.play_round(0, orders[0], agents[0])
    _, _, makespans, feasible = time_batch(
        orders, agents, instance.mean_durations, instance.lags, instance.near, instance.deadlines
    )
    result = simulator.round_results(0)[0]
    assert result["feasible"] == feasible[0]
    if feasible[0]:
        assert result["makespan"] == makespans[0]


def as_data(instance: MurseInstance, order: np.ndarray, agents: np.ndarray, starts: np.ndarray) -> dict:
    """A schedule's data made without the simulator."""
    durations = [int(instance.mean_durations[i, a]) for i, a in zip(order, agents, strict=True)]
    waits = [[{"after": int(j) + 1, "time": int(w)} for k, j, w in instance.waits if k == i] for i in range(len(order))]
    return {
        "proximity": instance.proximity,
        "safety_distance": instance.safety_distance,
        "longest": 10**9,
        "tasks": [
            {
                "deadline": None if instance.deadlines[i] < 0 else int(instance.deadlines[i]),
                "waits": waits[i],
                "location": instance.locations[i].tolist(),
                "eligible": np.flatnonzero(instance.eligible[i]).tolist(),
            }
            for i in range(len(order))
        ],
        "dispatch": [
            {"task": int(i) + 1, "agent": int(a), "duration": d, "start": int(starts[i]), "finish": int(starts[i]) + d}
            for i, a, d in zip(order, agents, durations, strict=True)
        ],
    }


def good() -> dict:
    """Tasks 1 [0, 4), 2 [4, 7) and 3 [9, 11), as worked out in test_rounds."""
    return schedule(played(MurseSimulator([three_tasks(deadlines=[-1, 7, 11])]), [1, 2, 3]))


def test_validator_confirms_the_schedule_worked_out_by_hand():
    verdict = validate(good())
    assert verdict.feasible
    assert verdict.starts == {1: 0, 2: 4, 3: 9}
    assert verdict.makespan == 11
    assert verdict.given_broken == verdict.differing == []


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda d: d["dispatch"][2].update(start=8, finish=10), "task 3: starts at 8, less than 5 after task 1"),
        (lambda d: d["dispatch"][1].update(start=3, finish=6), "tasks 1 and 2: too close to overlap"),
        (lambda d: d["dispatch"][1].update(finish=6), "task 2: finish 6 is not start 4 + duration 3"),
        (lambda d: d["tasks"][1].update(deadline=6), "task 2: finishes at 7 after its deadline 6"),
        (lambda d: d["tasks"][0].update(eligible=[1]), "task 1: agent 0 is not eligible"),
        (lambda d: d["dispatch"].pop(), "task 3: dispatched 0 times"),
        (lambda d: d["dispatch"].append(dict(d["dispatch"][0])), "task 1: dispatched 2 times"),
        (lambda d: d["dispatch"][1].update(agent=0, start=2, finish=5), "tasks 1 and 2: agent 0 does both at once"),
        (lambda d: d["dispatch"][0].update(committed=1), "task 1: starts at 0 before its agent committed"),
        (lambda d: d.update(longest=10), "the round takes 11, more than 10"),
    ],
)
def test_validator_refutes_every_broken_constraint(change, complaint):
    data = copy.deepcopy(good())
    change(data)
    assert any(complaint in found for found in validate(data).given_broken)


def test_validator_finds_tasks_that_must_precede_each_other():
    data = good()
    data["tasks"][0]["waits"] = [{"after": 2, "time": 0}]
    assert validate(data).broken == ["order: tasks must precede each other"]


def test_schedule_is_written_as_it_is_and_only_when_its_round_has_ended(tmp_path):
    simulator = MurseSimulator([three_tasks()])
    with pytest.raises(InvalidOptionError, match="0 rounds have ended"):
        schedule(simulator)
    played(simulator, [1, 2, 3])
    save_schedule(simulator, tmp_path / "schedule.json")
    assert read_json(tmp_path / "schedule.json") == schedule(simulator)


def test_validator_imports_nothing_but_the_standard_library():
    tree = ast.parse(Path(validation.__file__).read_text())
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert modules == {"__future__", "math", "collections.abc", "dataclasses", "graphlib", "typing"}

"""The upper bound is one, and the index scheduler comes close to it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import combinations, product

import numpy as np
import pytest

from marl_sched.agents.airme.bound.index import IndexScheduler
from marl_sched.agents.airme.bound.plane import immortal_values, plane_model, reward_of, solve
from marl_sched.agents.airme.bound.relaxation import Relaxation, price_segments, upper_bounds
from marl_sched.agents.airme.schedulers import RULES
from marl_sched.agents.base import Scheduler
from marl_sched.envs.airme.aircraft import FIXED_WING, HELICOPTER, AircraftType
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.errors import InvalidOptionError, UnknownNameError
from marl_sched.privileged import PrivilegedInfo

HOURS = 20
# Fails with probability 1/1.5 exp(-l/1.5) at l landings: 0.342 at one, 0.176 at two; hours do not matter.
FRAIL = AircraftType(name="frail", scales=(1.5,), shapes=(1.0,), hour_norm=1.0, usage=0.8, income=(1.0, 20.0))
RESERVE = AircraftType(name="reserve", scales=(1e9,), shapes=(2.0,), hour_norm=1.0, usage=0.0, income=(1.0, 20.0))


def tiny(n_crews: int) -> AirmeInstance:
    """A frail plane with a landing on the clock, and a broken one that only stands about."""
    return AirmeInstance(
        n_crews=n_crews, kind=[0, 1], income=[12.0, 5.0], hours=[7, 0], landings=[1, 0], broken=[False, True],
        types=(FRAIL, RESERVE),
    )  # fmt: skip


# A plane's state: ("up", kind, landings, hours of mission to go), ("down", kind, landings) or ("shop", kind, hours to
# go). Hours on the clock stay below 24 here, so that no duration depends on them.
State = tuple
Outcome = tuple[float, float, State]


def outcomes_of_waiting(state: State, income: float, objective: str) -> Iterator[Outcome]:
    """(probability, reward, next state) of an hour without a decision; written apart from the library's code."""
    up = 1.0 if objective == "availability" else income
    stood = 1.0 if objective == "availability" else 0.0
    if state[0] == "shop":
        _, kind, left = state
        yield 1.0, 0.0, ("up", kind, 0, 0) if left == 1 else ("shop", kind, left - 1)
        return
    if state[0] == "down":
        yield 1.0, 0.0, state
        return
    _, kind, landings, left = state
    starts = [(1.0, left)]
    if left == 0:
        usage = 0.8 if kind == "frail" else 0.0
        starts = [(usage / 6, length) for length in (5, 6, 7, 8, 9, 10)]
        yield 1.0 - usage, stood, state
    fails = 2 / 3 * np.exp(-landings / 1.5) if kind == "frail" and landings else 0.0
    for share, length in starts:
        yield share * fails, 0.0, ("down", kind, landings)
        landed = ("up", kind, landings + 1, 0) if length == 1 else ("up", kind, landings, length - 1)
        yield share * (1 - fails), up, landed


def outcomes_of_repair(state: State, income: float, objective: str, hours_left: int) -> Iterator[Outcome]:
    """The same for a repair that starts now, charged at once for the hours that the episode holds."""
    kind, landings, broken = state[1], state[2], state[0] == "down"
    for draw in (2, 3, 4, 5, 6, 7, 8):
        length = draw + landings // 6 + 12 * broken
        cost = (0.55 * income + 48 * broken) / length + 2 if objective == "profit" else 0.0
        after = ("up", kind, 0, 0) if length == 1 else ("shop", kind, length - 1)
        yield 1 / 7, -cost * min(length, hours_left), after


def best_expected_return(n_crews: int, objective: str) -> float:
    """The optimum of the two planes together over all schedulers, by exhaustive recursion, as M1."""
    incomes = (12.0, 5.0)

    @cache
    def value(hours_left: int, states: tuple[State, State]) -> float:
        if hours_left == 0:
            return 0.0
        busy = sum(state[0] == "shop" for state in states)
        waiting = [i for i, state in enumerate(states) if state[0] != "shop"]
        best = -np.inf
        for n in range(min(n_crews - busy, len(waiting)) + 1):
            for served in combinations(waiting, n):
                branches = [
                    list(outcomes_of_repair(state, incomes[i], objective, hours_left))
                    if i in served
                    else list(outcomes_of_waiting(state, incomes[i], objective))
                    for i, state in enumerate(states)
                ]
                total = 0.0
                for (p, r, a), (q, s, b) in product(*branches):
                    if p * q > 0.0:
                        total += p * q * (r + s + value(hours_left - 1, (a, b)))
                best = max(best, total)
        return best

    scale = 2.0 if objective == "availability" else sum(incomes)
    return value(HOURS, (("up", "frail", 1, 0), ("down", "reserve", 0))) / scale / HOURS


@pytest.mark.parametrize("objective", ["profit", "revenue", "availability"])
def test_with_a_crew_for_every_plane_the_bound_is_the_optimum_found_by_brute_force(objective: str) -> None:
    relaxation = Relaxation([tiny(2)], objective=objective, horizon=HOURS)
    assert relaxation.bounds(np.zeros(HOURS))[0] == pytest.approx(best_expected_return(2, objective), rel=1e-12)


@pytest.mark.parametrize("objective", ["revenue", "availability"])
def test_bound_is_above_the_optimum_found_by_brute_force_when_crews_are_short(objective: str) -> None:
    optimum = best_expected_return(1, objective)
    relaxation = Relaxation([tiny(1)], objective=objective, horizon=HOURS)
    free = relaxation.bounds(np.zeros(HOURS))[0]
    bound = upper_bounds(relaxation, evaluations=30).value[0]
    assert optimum <= bound + 1e-12
    assert bound <= free
    if objective == "availability":  # the other plane earns nothing that the crew could be missed for
        assert optimum < bound < free
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert relaxation.bounds(rng.exponential(3.0, HOURS) * (rng.random(HOURS) < 0.5))[0] >= optimum


def episodes(scheduler: Scheduler, instances: list[AirmeInstance], n: int, **options: object) -> np.ndarray:
    """M1 of n episodes of every instance, float64 (N, n)."""
    simulator = AirmeSimulator([i for i in instances for _ in range(n)], **options)
    simulator.reset(seed=1, episodes=np.tile(np.arange(n), len(instances)))
    scheduler.start(simulator, np.ones(simulator.batch, bool))
    while not simulator.over.all():
        simulator.step(scheduler.decide(simulator))
    return simulator.objectives()[simulator.objective].reshape(len(instances), n)


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["profit", "revenue", "availability"])
def test_with_a_crew_for_every_plane_simulation_reaches_the_bound(objective: str) -> None:
    small = generate("small", np.random.default_rng(3))
    columns = {name: getattr(small, name)[12:20] for name in ("kind", "income", "hours", "landings", "broken")}
    instance = AirmeInstance(n_crews=8, **columns)
    bound = Relaxation([instance], objective=objective, nodes=8).bounds(np.zeros(720))[0]
    m1 = episodes(IndexScheduler(), [instance], 400, objective=objective)[0]
    assert m1.mean() == pytest.approx(bound, abs=2 * m1.std(ddof=1) / np.sqrt(len(m1)))


@pytest.mark.slow
def test_bound_is_above_every_schedulers_mean_and_the_index_comes_close() -> None:
    instances = [generate("small", np.random.default_rng([5, i])) for i in range(12)]
    bound = upper_bounds(Relaxation(instances, nodes=4), price_vectors=1, evaluations=7).value
    for name in RULES:
        m1 = episodes(RULES[name](), instances, 4)
        error = m1.std(axis=1, ddof=1).mean() / np.sqrt(m1.size)
        assert m1.mean() < bound.mean() + 2 * error, name
    index = episodes(IndexScheduler(), instances, 4).mean()
    assert index == pytest.approx(bound.mean(), abs=0.005)
    assert index > episodes(IndexScheduler(clock=False), instances, 4).mean()
    assert index > episodes(RULES["preventive-first"](), instances, 4).mean() + 0.005


def test_slope_is_the_change_of_the_mean_bound_with_a_price() -> None:
    instances = [generate("small", np.random.default_rng(i)) for i in range(2)]
    relaxation = Relaxation(instances, horizon=60, nodes=3)
    chosen, rng = np.array([True, True]), np.random.default_rng(0)
    prices = rng.uniform(0, 10, 60)
    _, slope = relaxation.mean_and_slope(prices, chosen)
    for direction in (np.eye(60)[3], np.eye(60)[40], rng.random(60)):
        step = 1e-6 * direction
        change = relaxation.bounds(prices + step).mean() - relaxation.bounds(prices - step).mean()
        assert change / 2e-6 == pytest.approx(slope @ direction, rel=1e-4, abs=1e-9)


def test_bound_is_convex_in_the_prices() -> None:
    relaxation = Relaxation([generate("small", np.random.default_rng(1))], horizon=60, nodes=3)
    rng = np.random.default_rng(0)
    for _ in range(5):
        a, b = rng.exponential(8.0, (2, 60))
        middle = relaxation.bounds((a + b) / 2)[0]
        assert middle <= (relaxation.bounds(a)[0] + relaxation.bounds(b)[0]) / 2 + 1e-12


@pytest.mark.slow
def test_minimising_lowers_the_bound_and_fewer_income_nodes_raise_it() -> None:
    relaxation = Relaxation([generate("small", np.random.default_rng(1))], horizon=100)
    prices = relaxation.minimise(evaluations=10)
    assert (prices >= 0).all()
    assert relaxation.bounds(prices)[0] < relaxation.bounds(np.zeros(100))[0] - 0.01
    by_nodes = [
        Relaxation([generate("small", np.random.default_rng(1))], horizon=100, nodes=nodes).bounds(prices)[0]
        for nodes in (2, 3, 6, 24)
    ]
    assert by_nodes == sorted(by_nodes, reverse=True)
    assert by_nodes[2] - by_nodes[3] < 5e-4


@pytest.mark.parametrize("kind", [FIXED_WING, HELICOPTER])
def test_no_plane_is_worth_more_than_one_that_never_fails(kind: AircraftType) -> None:
    rng = np.random.default_rng(0)
    model = plane_model(kind, "density", rng.integers(0, 121, 50), rng.integers(0, 27, 50))
    for objective in ("profit", "revenue", "availability"):
        reward = reward_of(objective, 10.0)
        value, new = solve(model, reward, np.zeros(200), np.zeros((0, 11, 51, 301), np.uint8))
        immortal = immortal_values(model, reward, 200)
        for state in range(10):
            assert (value[state, :-1, :-1] <= immortal[0, state] + 1e-9).all()
        assert (new <= immortal[:, 0] + 1e-9).all()


def test_price_segments_cover_the_episode_in_order() -> None:
    for horizon in (1, 2, 10, 100, 720):
        segment = price_segments(horizon)
        assert segment[0] == 0
        assert set(np.diff(segment)) <= {0, 1}


def test_bad_option_raises() -> None:
    instance = tiny(1)
    with pytest.raises(UnknownNameError, match="did you mean 'profit'"):
        Relaxation([instance], objective="profits")
    with pytest.raises(InvalidOptionError, match="same aircraft types"):
        Relaxation([instance, generate("small", np.random.default_rng(0))])
    with pytest.raises(InvalidOptionError, match="prices: expected 20 numbers >= 0"):
        Relaxation([instance], horizon=HOURS).bounds(-np.ones(HOURS))
    with pytest.raises(InvalidOptionError, match="horizon and nodes"):
        Relaxation([instance], nodes=1)


class TestIndexScheduler:
    def test_says_what_it_knows(self) -> None:
        assert str(IndexScheduler().privileged_info) == "failure model and clock"
        assert IndexScheduler(clock=False).privileged_info is PrivilegedInfo.FAILURE_MODEL

    def test_serves_a_worn_plane_and_leaves_a_new_one_alone(self) -> None:
        instance = AirmeInstance(
            n_crews=3, kind=[0, 0, 0], income=[10.0, 10.0, 10.0], hours=[0, 60, 70], landings=[0, 8, 9],
            broken=[False, False, False],
        )  # fmt: skip
        simulator = AirmeSimulator([instance])
        scheduler = IndexScheduler()
        taken = []
        for _ in range(3):
            action = scheduler.decide(simulator)
            taken.append(int(action[0]))
            simulator.step(action)
        assert sorted(taken[:2]) == [2, 3]
        assert taken[2] == 0

    def test_repairs_nothing_for_profit_in_the_last_hours(self) -> None:
        instance = generate("small", np.random.default_rng(0))
        simulator = AirmeSimulator([instance], horizon=6)
        scheduler = IndexScheduler()
        scheduler.start(simulator, np.ones(1, bool))
        while not simulator.over[0]:
            action = scheduler.decide(simulator)
            assert action[0] == 0
            simulator.step(action)

    def test_gives_planes_that_it_does_not_see_no_index(self) -> None:
        simulator = AirmeSimulator([generate("small", np.random.default_rng(0))])
        seen = simulator.observe(simulator.acting)
        for name in ("plane", "plane_mask", "action_mask"):
            seen[name][0, 1:] = 0
        assert IndexScheduler().choose(seen, np.zeros(1))[0] == 0

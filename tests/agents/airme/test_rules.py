"""Rules of AirME against tiny fleets, and against a centralised priority queue written independently."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chisquare, weibull_min

from marl_sched.agents.airme.light_rules import RandomRule
from marl_sched.agents.airme.rules import (
    ModelBasedRule,
    PeriodicRule,
    condition,
    corrective,
    corrective_as_published,
    preventive_first,
)
from marl_sched.agents.airme.schedulers import RULES
from marl_sched.agents.base import ObservationScheduler
from marl_sched.envs.airme.aircraft import PUBLISHED_TYPES, AircraftType, FailureModel
from marl_sched.envs.airme.instance import AirmeInstance, generate
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.errors import InvalidOptionError
from marl_sched.privileged import PrivilegedInfo

FIXED, HELI = 0, 1


def fleet_of(*planes: tuple[int, float, int, int, bool], n_crews: int = 1) -> AirmeInstance:
    """An instance from rows of (kind, income, hours, landings, broken)."""
    kind, income, hours, landings, broken = zip(*planes, strict=True)
    return AirmeInstance(
        n_crews=n_crews,
        kind=np.array(kind), income=np.array(income), hours=np.array(hours), landings=np.array(landings),
        broken=np.array(broken),
    )  # fmt: skip


def order(rule: ObservationScheduler, instance: AirmeInstance, failure: FailureModel = "density") -> list[int]:
    """The slots that crews in turn are sent to in hour 0, up to the first that stays."""
    simulator = AirmeSimulator([instance], failure=failure)
    rule.start(simulator, np.ones(1, bool))
    slots: list[int] = []
    while simulator.time[0] == 0:
        action = int(rule.decide(simulator)[0])
        simulator.step(np.array([action]))
        if action == 0:
            break
        slots.append(action)
    return slots


def test_corrective_serves_broken_planes_by_income() -> None:
    instance = fleet_of((FIXED, 3.0, 0, 0, True), (FIXED, 9.0, 110, 20, False), (HELI, 7.0, 0, 0, True), n_crews=3)
    assert order(corrective(), instance) == [3, 1]


def test_corrective_as_published_serves_broken_planes_in_plane_order() -> None:
    instance = fleet_of((FIXED, 3.0, 0, 0, True), (FIXED, 9.0, 110, 20, False), (HELI, 7.0, 0, 0, True), n_crews=3)
    assert order(corrective_as_published(), instance) == [1, 3]


def test_condition_serves_broken_planes_by_income_then_worn_ones_from_40_hours_by_hours() -> None:
    instance = fleet_of(
        (FIXED, 1.0, 40, 0, False), (FIXED, 19.0, 39, 20, False), (HELI, 1.0, 80, 0, False),
        (HELI, 2.0, 90, 0, True), (FIXED, 5.0, 10, 0, True), n_crews=5,
    )  # fmt: skip
    assert order(condition(), instance) == [5, 4, 3, 1]
    assert order(condition(threshold=39), instance) == [5, 4, 3, 1, 2]


def test_periodic_acts_only_in_every_sixth_hour_and_then_on_all_planes() -> None:
    instance = fleet_of((FIXED, 1.0, 4, 0, False), (FIXED, 19.0, 39, 20, False), (HELI, 2.0, 0, 0, True), n_crews=3)
    assert order(PeriodicRule(), instance) == [3, 2, 1]
    simulator = AirmeSimulator([generate("small", np.random.default_rng(0))], horizon=30)
    hours = set()
    while not simulator.over[0]:
        action = PeriodicRule().decide(simulator)
        if action[0]:
            hours.add(int(simulator.time[0]))
        simulator.step(action)
    assert len(hours) >= 3
    assert hours <= {0, 6, 12, 18, 24}
    with pytest.raises(InvalidOptionError, match="at least 1 hour, got 0"):
        PeriodicRule(0)


def risk(kind: int, hours: int, landings: int) -> float:
    """1 - prod(1 - p_k), from table 6.1 by SciPy."""
    scales, shapes, norm = [([15, 12, 18, 16], [5.0, 5.5, 6.0, 6.5], 20), ([8, 7, 5], [7, 6, 11], 15)][kind]
    survival = 1.0
    for part, (scale, shape) in enumerate(zip(scales, shapes, strict=True)):
        x = landings if part == 0 else (hours / norm if hours > 5 else 0.0)
        survival *= 1 - weibull_min.pdf(x, shape, scale=scale)
    return 1 - survival


def test_model_based_serves_worn_planes_by_their_true_failure_probability_from_0_004() -> None:
    # Fixed-wing, 1/3 (l/15)^4 exp(-(l/15)^5): 0.00168 at 4 landings, 0.00410 at 5. Helicopter,
    # 7/8 (l/8)^6 exp(-(l/8)^7): 0.00243 at 3, 0.0136 at 4. Hours near 20 add nothing that shows.
    instance = fleet_of(
        (FIXED, 9.0, 20, 4, False), (FIXED, 1.0, 20, 5, False), (HELI, 9.0, 20, 3, False), (HELI, 1.0, 20, 4, False),
        (HELI, 1.0, 0, 0, True), n_crews=5,
    )  # fmt: skip
    assert order(ModelBasedRule(), instance) == [5, 4, 2]
    assert ModelBasedRule().privileged_info is PrivilegedInfo.FAILURE_MODEL


def test_model_based_knows_the_hazard_where_parts_fail_by_it() -> None:
    # Fixed-wing at 30 landings: the density is 1/3 x 16 x exp(-32) = 7e-14, the hazard 1/3 x 16, capped at 1.
    instance = fleet_of((FIXED, 9.0, 0, 30, False), (FIXED, 9.0, 20, 5, False), n_crews=3)
    assert order(ModelBasedRule(), instance) == [2]
    assert order(ModelBasedRule(), instance, failure="hazard") == [1, 2]


def drones(n_types: int) -> AirmeInstance:
    """A plane of each of `n_types` types, the first of which fails soonest: 3/9 (l/9)^2 exp(-(l/9)^3), l = 6."""
    types = tuple(
        AircraftType(name=f"drone {k}", scales=(9.0 + 9 * k,), shapes=(3.0,), hour_norm=1, usage=0.5, income=(1, 2))
        for k in range(n_types)
    )
    kind, same = np.arange(n_types)[::-1], np.ones(n_types)
    return AirmeInstance(
        n_crews=n_types + 1, kind=kind, income=same, hours=same * 6, landings=same * 6, broken=same < 0, types=types
    )


@pytest.mark.parametrize("n_types", [1, 3])
def test_model_based_and_the_index_plan_for_the_fleets_own_types(n_types: int) -> None:
    # Landing densities at 6: 0.110 of scale 9, 0.0178 of scale 18, 0.0054 of scale 27.
    assert order(ModelBasedRule(), drones(n_types)) == [*range(n_types, 0, -1)]
    simulator = AirmeSimulator([drones(n_types)], horizon=4)
    scheduler = RULES["index"]()
    scheduler.start(simulator, np.ones(1, bool))
    assert 0 <= scheduler.decide(simulator)[0] <= n_types


@pytest.mark.parametrize("name", ["model-based", "index", "index-without-clock"])
@pytest.mark.parametrize("n_types", [1, 3])
def test_rules_that_know_the_failure_model_refuse_types_they_were_not_made_for(name: str, n_types: int) -> None:
    simulator = AirmeSimulator([drones(n_types)])
    message = (
        f"{name}: its failure model knows 2 aircraft types .fixed_wing, helicopter., the observation has {n_types}"
    )
    with pytest.raises(InvalidOptionError, match=message):
        RULES[name]().decide(simulator)


def test_preventive_first_serves_worn_planes_before_broken_ones() -> None:
    instance = fleet_of(
        (FIXED, 2.0, 45, 0, False),  # 45 x 2 = 90
        (FIXED, 19.0, 44, 30, False),  # not worn
        (HELI, 3.0, 10, 4, False),  # 10 x 3 = 30
        (HELI, 9.0, 90, 3, False),  # not worn
        (FIXED, 5.0, 60, 9, True),
        (FIXED, 1.5, 80, 0, False),  # 80 x 1.5 = 120
        (HELI, 8.0, 60, 9, True),
        n_crews=8,
    )
    assert order(preventive_first(), instance) == [6, 1, 3, 7, 5]
    assert order(preventive_first(hours=44, landings=3), instance)[:2] == [2, 4]


def test_random_draws_every_open_plane_and_the_null_plane_alike() -> None:
    simulator = AirmeSimulator([generate("small", np.random.default_rng(2))], seed=1)
    for action in (5, 9):
        simulator.step(np.array([action]))
    seen = simulator.observe(simulator.acting)
    n = 20_000
    many = {name: np.repeat(value, n, axis=0) for name, value in seen.items()}
    actions = RandomRule().choose(many, np.random.default_rng(0).random(n))
    counts = np.bincount(actions, minlength=simulator.max_actions)
    legal = np.flatnonzero(seen["action_mask"][0])
    assert counts[[5, 9]].tolist() == [0, 0]
    assert counts.sum() == counts[legal].sum() == n
    assert chisquare(counts[legal]).pvalue > 1e-4


def test_random_uses_the_whole_unit_interval() -> None:
    simulator = AirmeSimulator([fleet_of(*[(FIXED, 1.0, 0, 0, False)] * 3)])
    own = {k: v[0] for k, v in simulator.observe(simulator.acting).items()}
    assert [RandomRule().act(own, u) for u in (0, 0.24, 0.25, 0.74, 1 - 1e-15)] == [0, 0, 1, 2, 3]


Key = Callable[[int, float, int, int, bool], tuple[float, ...] | None]
# What a plane's place in the queue is, smallest first; None: not in the queue.
QUEUES: dict[str, Key] = {
    "corrective": lambda kind, income, hours, landings, broken: (-income,) if broken else None,
    "corrective-published": lambda kind, income, hours, landings, broken: () if broken else None,
    "condition": lambda kind, income, hours, landings, broken: (
        (0, -income) if broken else (1, -hours) if hours >= 40 else None
    ),
    "model-based": lambda kind, income, hours, landings, broken: (
        (0, -income) if broken else (1, -risk(kind, hours, landings)) if risk(kind, hours, landings) >= 0.004 else None
    ),
    "preventive-first": lambda kind, income, hours, landings, broken: (
        (1, -income) if broken else (0, -hours * income) if (landings >= 4 if kind == HELI else hours >= 45) else None
    ),
}


def queue(simulator: AirmeSimulator, key: Key) -> list[int]:
    """Slots of the free planes in the order of a centralised priority queue, ties by slot."""
    entries = []
    for slot in range(1, int(simulator.state.rows["n_planes"][0]) + 1):
        plane = simulator.state.planes[0, slot]
        place = key(*(plane[k].item() for k in ("kind", "income", "hours", "landings", "broken")))
        if plane["crew"] < 0 and place is not None:
            entries.append((place, slot))
    return [slot for _, slot in sorted(entries)]


@pytest.mark.parametrize("name", QUEUES)
def test_crews_in_turn_take_the_head_of_a_central_queue(name: str) -> None:
    rule = RULES[name]()
    for seed in range(3):
        simulator = AirmeSimulator([generate("small", np.random.default_rng(seed))], horizon=120, seed=seed)
        while not simulator.over[0]:
            hour, expected, free = int(simulator.time[0]), queue(simulator, QUEUES[name]), len(simulator.free_agents(0))
            taken = []
            while simulator.time[0] == hour and not simulator.over[0]:
                action = rule.decide(simulator)
                taken.append(int(action[0]))
                simulator.step(action)
            assert taken == (expected + [0] * free)[:free], (seed, hour)


@pytest.mark.parametrize("name", RULES)
def test_rules_choose_only_what_is_legal_and_agree_between_batch_and_agent(name: str) -> None:
    rule = RULES[name]()
    assert rule.name == name
    instances = [generate("small", np.random.default_rng(seed)) for seed in range(4)]
    simulator = AirmeSimulator(instances, horizon=60, seed=1)
    while not simulator.over.all():
        seen, uniform = simulator.observe(simulator.acting), simulator.policy_noise(simulator.acting)
        actions = rule.decide(simulator)
        assert (seen["action_mask"][np.arange(4), actions] == 1).all()
        for b in range(4):
            own = {k: v[b] for k, v in seen.items()}
            nodes = {k: v for k, v in own.items() if k != "action_mask"}
            nested = {"observation": nodes, "action_mask": own["action_mask"]}
            assert rule.act(own, uniform[b]) == rule.act(nested, uniform[b]) == actions[b]
        simulator.step(actions)


def test_published_types_are_those_of_the_risk_above() -> None:
    assert [kind.name for kind in PUBLISHED_TYPES] == ["fixed_wing", "helicopter"]

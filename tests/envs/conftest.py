"""What the tests of the environment APIs share. Every test that takes `domain` runs for each domain that ships."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
import pytest

from marl_sched.domain import Domain, get_domain

DOMAINS = ("airme", "murse", "ward")

# A Dict observation with an action mask, which PettingZoo's own documentation recommends, raises these two.
MASK_WARNINGS = (
    "Observation is not a NumPy array",
    "Observation space for each agent probably should be gymnasium.spaces.box or gymnasium.spaces.discrete",
)


@pytest.fixture(params=DOMAINS)
def domain(request: pytest.FixtureRequest) -> Domain:
    return get_domain(request.param)


@pytest.fixture(params=("full", "local"))
def view(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def only_mask_warnings() -> Iterator[None]:
    """Turns every warning into an error, save the two named above."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for message in MASK_WARNINGS:
            warnings.filterwarnings("ignore", message=message)
        yield


@pytest.fixture
def largest_crew(domain: Domain) -> object:
    """A small instance with as many agents as the padding allows."""
    for instance in domain.instances("small", 50, seed=0):
        simulator = make_simulator(domain, [instance])
        if simulator.n_agents[0] == simulator.max_agents:
            return instance
    raise AssertionError("none of 50 instances has the most agents")


@pytest.fixture
def padded(domain: Domain) -> object:
    """A small instance with fewer agents and actions than the padding allows."""
    for instance in domain.instances("small", 50, seed=0):
        simulator = make_simulator(domain, [instance])
        own = domain.simulator([instance], view=domain.make_view(None))
        if own.max_agents < simulator.max_agents and own.max_actions < simulator.max_actions:
            return instance
    raise AssertionError("none of 50 instances is smaller than the padding")


def make_simulator(domain: Domain, instances: list[object], **options: object):
    return domain.simulator(instances, view=domain.make_view(None), pad="small", **options)


@pytest.fixture
def pick():
    """A choice that depends on nothing but the mask and the number of the turn."""

    def choose(mask: np.ndarray, turn: int) -> int:
        legal = np.flatnonzero(mask)
        return int(legal[(7 * turn + 3) % len(legal)])

    return choose


@pytest.fixture
def bits():
    """A snapshot as bytes, field by field: the gaps between the fields of a record say nothing."""

    def of(snapshot: dict[str, np.ndarray]) -> dict[str, bytes]:
        out = {}
        for name, array in snapshot.items():
            for field in array.dtype.names or ("",):
                out[f"{name}.{field}"] = np.ascontiguousarray(array[field] if field else array).tobytes()
        return out

    return of

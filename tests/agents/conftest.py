"""Metagraphs that use every pattern, and random observations of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pytest
import torch

from marl_sched.graph import DECISION, STATE, GraphSpec, NodeType, Relation

Observation = dict[str, torch.Tensor]
SIZES = {"fleet": {"plane": 9, "crew": 4}, "workshop": {"task": 7, "agent": 3, "place": 3}}


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> Iterator[None]:
    """Graphs of ten nodes are too small to share among threads, which wait for each other on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def named(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{i}" for i in range(count))


def fleet_graph() -> GraphSpec:
    """AirME's metagraph (dissertation, figure 6.2) with fewer features."""
    return GraphSpec(
        nodes=(NodeType("plane", named("plane", 5)), NodeType("crew", named("crew", 3))),
        state_features=named("state", 4),
        relations=(
            Relation("crew", "repairing", "plane", "scatter", index="repairing"),
            Relation("plane", "repaired_by", "crew", "gather", index="repairing"),
            Relation("plane", "in", STATE, "all", attention=True),
            Relation("crew", "in", STATE, "all", attention=True),
            Relation("plane", "to", DECISION, "same"),
            Relation(STATE, "to", DECISION, "all"),
        ),
        decision_of="plane",
    )


def workshop_graph() -> GraphSpec:
    """Every pattern with and without attention, and with edge attributes where they are possible."""
    return GraphSpec(
        nodes=(
            NodeType("task", named("task", 4)),
            NodeType("agent", named("agent", 3)),
            NodeType("place", named("place", 2)),
        ),
        state_features=named("state", 3),
        relations=(
            Relation("task", "temporal", "task", "dense", attention=True, attributes=("min", "max")),
            Relation("task", "aug", "task", "dense", attributes=("wait",)),
            Relation("agent", "use_time", "task", "dense", attention=True),
            Relation("task", "near", "place", "dense"),
            Relation("task", "assigned_to", "agent", "scatter", attention=True, index="assigned"),
            Relation("agent", "works_on", "task", "gather", attention=True, index="assigned"),
            Relation("task", "located_in", "place", "scatter", index="location"),
            Relation("place", "holds", "task", "gather", index="location"),
            Relation("agent", "at", "place", "same", attention=True),
            Relation("agent", "team", "agent", "all"),
            Relation("task", "in", STATE, "all", attention=True),
            Relation("place", "in", STATE, "all"),
            Relation(STATE, "frames", "task", "all", attention=True),
            Relation("agent", "to", DECISION, "all", attention=True),
            Relation("task", "to", DECISION, "same"),
            Relation(STATE, "to", DECISION, "all"),
        ),
        decision_of="task",
    )


GRAPHS = {"fleet": fleet_graph, "workshop": workshop_graph}


@pytest.fixture(params=list(GRAPHS))
def graph_name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def graph(graph_name: str) -> GraphSpec:
    return GRAPHS[graph_name]()


@pytest.fixture
def sizes(graph_name: str) -> dict[str, int]:
    return SIZES[graph_name]


@pytest.fixture
def fleet() -> GraphSpec:
    return fleet_graph()


@pytest.fixture
def observe() -> Callable[..., Observation]:
    """(graph, sizes, batch, seed) -> a random observation with hidden nodes; action 0 is visible and legal."""
    return random_observation


def random_observation(graph: GraphSpec, sizes: Mapping[str, int], batch: int = 3, seed: int = 0) -> Observation:
    rng = np.random.default_rng(seed)
    out: dict[str, np.ndarray] = {}
    for name, spec in graph.arrays(dict(sizes)).items():
        shape = (batch, *spec.shape)
        if spec.dtype == np.int8:
            out[name] = (rng.random(shape) < 0.7).astype(np.int8)
        elif spec.dtype == np.int64:
            out[name] = rng.integers(-1, int(spec.high) + 1, shape)
        else:
            out[name] = rng.normal(size=shape).astype(np.float32)
    decided = f"{graph.decision_of}_mask"
    out[decided][:, 0] = 1
    out["action_mask"] = out["action_mask"] * out[decided]
    out["action_mask"][:, 0] = 1
    return {name: torch.from_numpy(array) for name, array in out.items()}

"""MuRSE on the wire: what the world says at every decision epoch, for agents whose neighbourhood moves with them.

Channels, each with the newest state as its payload (msgpack):

    team/now                 round and clock, for all
    <who>/tasks              the tasks in sight, with their deadlines, waits and places
    <who>/estimates          what agents within hearing are expected to take for the tasks in sight
    <who>/commitments        where agents within hearing stand, and which tasks are known to be taken, with the times
                             that can be told of them now: a running task ends when it is expected to

Under a view that hides nothing, <who> is `team`: everybody hears the same. Under a local view it is `agent/<id>`: the
world stands for the sensors and the radio of that agent, whose reach moves with it, and says on its channels what
they bring in, which includes what the agent learnt from a conflict. No other agent hears them.

An agent's side is marl_sched.envs.murse.local_state.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import msgspec
import numpy as np

from marl_sched.envs.murse.graph import SIMPLIFICATIONS
from marl_sched.envs.murse.simulator import MurseSimulator
from marl_sched.envs.murse.state import NOBODY
from marl_sched.envs.murse.views import Sight, new_sight, standpoint, survey
from marl_sched.errors import InvalidMessageError

if TYPE_CHECKING:
    from marl_sched.envs.murse.local_state import MurseLocalState

Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Size = Annotated[int, msgspec.Meta(ge=1, lt=2**16)]
Time = Annotated[int, msgspec.Meta(ge=-1, lt=2**40)]  # -1: none
Index = Annotated[int, msgspec.Meta(ge=-1, lt=2**16)]

NOW = "team/now"
TASKS, ESTIMATES, COMMITMENTS = "tasks", "estimates", "commitments"


class Payload(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """A payload names its type and the type's version, so that a reader of another version refuses it."""


class Frame(Payload, tag="murse.frame.1", frozen=True):
    """What every agent is told at the start: the sizes, the unit of durations, and how the world plays."""

    n_tasks: Size
    n_agents: Size
    n_robots: Count
    max_tasks: Size  # the padding
    max_agents: Size
    longest: Size  # possible duration, by which an observation divides
    simplification: Annotated[int, msgspec.Meta(ge=0, lt=len(SIMPLIFICATIONS))]
    mode: Literal["plan", "online"]
    proximity: Literal["distance", "location", "none"]  # what keeps tasks apart
    safety_distance: Annotated[float, msgspec.Meta(ge=0)]
    shared: bool  # whether all agents hear the same, because the view hides nothing


class Now(Payload, tag="murse.now.1", frozen=True):
    """The moment: the clock counts from the round's start, `time` runs on over the rounds."""

    round: Count
    clock: Count
    time: Count
    over: bool


class SeenTask(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A task in sight; names as in state.TASK. What it waits for belongs to it: pairs of a task and a time."""

    task: Count
    x: float
    y: float
    weight: float
    deadline: Time
    place: Count
    waits: list[tuple[Count, Count]]
    near: list[Count]  # the tasks in sight that must not overlap with it


class Tasks(Payload, tag="murse.tasks.1", frozen=True):
    """The tasks in sight."""

    tasks: list[SeenTask]


class Estimate(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What an agent is expected to take for a task; `planned` -1: it cannot do it. Names as in state.PAIR."""

    agent: Count
    planned: Time
    mean: float
    spread: float
    repetitions: Count


class Estimates(Payload, tag="murse.estimates.1", frozen=True):
    """Of every task in sight the estimates of the agents within hearing."""

    tasks: list[tuple[Count, list[Estimate]]]


class HeardAgent(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """An agent within hearing: the last task that it took, -1 for none, and where it stands."""

    agent: Count
    last_task: Index
    x: float
    y: float


class TakenTask(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A task that is known to be taken, with its times as far as they can be told now."""

    task: Count
    agent: Count
    committed: Time  # clock of the decision; -1: learnt from a conflict, which does not tell it
    start: Time
    finish: Time


class Commitments(Payload, tag="murse.commitments.1", frozen=True):
    """Agents within hearing, tasks known to be taken in order of dispatch, and who of the listeners may decide now."""

    agents: list[HeardAgent]
    taken: list[TakenTask]
    free: list[Count]


P = TypeVar("P", bound=Payload)
_encode = msgspec.msgpack.Encoder().encode


def decode(payload: bytes, kind: type[P]) -> P:
    """The payload as a message of that kind; InvalidMessageError if it is anything else."""
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidMessageError(f"not a message of type {kind.__struct_config__.tag}: {error}") from error


class MurseTelemetry:
    """The world's side, and the way to an agent's; see marl_sched.domain_parts.Telemetry."""

    time_unit = "time"

    def frame(self, simulator: MurseSimulator) -> bytes:
        """Sizes, padding and settings of row 0."""
        row = simulator.state.rows[0]
        simplification = "sparse" if "aug" in simulator.arrays else "distance"
        return _encode(
            Frame(
                n_tasks=int(row["n_tasks"]),
                n_agents=int(row["n_agents"]),
                n_robots=int(row["n_robots"]),
                max_tasks=simulator.max_actions - 2,
                max_agents=simulator.max_agents,
                longest=int(row["high"]),
                simplification=SIMPLIFICATIONS.index(simplification),
                mode="online" if simulator.mode == "online" else "plan",
                proximity=simulator.instances[0].proximity,
                safety_distance=simulator.instances[0].safety_distance,
                shared=not simulator.view.hides,
            )
        )

    def messages(self, simulator: MurseSimulator, channels: Collection[str] | None = None) -> dict[str, bytes]:
        """The moment, and what every listener sees, knows and expects; only `channels` if they are given."""
        said: dict[str, bytes] = {}
        if channels is None or NOW in channels:
            row = simulator.state.rows[0]
            moment = Now(round=int(row["round"]), clock=int(row["clock"]), time=int(row["time"]), over=_over(simulator))
            said[NOW] = _encode(moment)
        sight = new_sight(simulator.state)
        for who, viewer in _listeners(simulator):
            wanted = [k for k in _WRITERS if channels is None or f"{who}/{k}" in channels]
            if wanted:
                survey(simulator.state, simulator.rules, 0, viewer, *simulator.view.limits, sight)
            for kind in wanted:
                said[f"{who}/{kind}"] = _encode(_WRITERS[kind](simulator, viewer, sight))
        return said

    def turn_channels(self, simulator: MurseSimulator, agent: int) -> list[str]:
        """Commitments; under a local view the agent has also moved, and others may hear it now or no longer."""
        listeners = _listeners(simulator)
        changed = [f"{who}/{COMMITMENTS}" for who, _ in listeners]
        if simulator.view.hides:
            changed += [f"agent/{agent}/{TASKS}", *(f"{who}/{ESTIMATES}" for who, _ in listeners)]
        return changed

    def series(self, simulator: MurseSimulator) -> dict[str, list[float]]:
        """Makespan, weighted completion time and feasibility of every round that has ended."""
        ended = int(simulator.progress[0])
        rounds = simulator.per_round()
        return {name: rounds[name][0, :ended].tolist() for name in ("makespan", "weighted", "feasible")}

    def local_state(self, frame: bytes, agent: int) -> MurseLocalState:
        """An agent's empty local state."""
        from marl_sched.envs.murse.local_state import MurseLocalState

        return MurseLocalState(decode(frame, Frame), agent)


def _listeners(simulator: MurseSimulator) -> list[tuple[str, int]]:
    """Who is told something of its own, and whose eyes and ears that takes."""
    if not simulator.view.hides:
        return [("team", 0)]
    return [(f"agent/{agent}", agent) for agent in range(int(simulator.n_agents[0]))]


def _over(simulator: MurseSimulator) -> bool:
    return bool(simulator.acting[0] == NOBODY)


def _tasks(simulator: MurseSimulator, viewer: int, sight: Sight) -> Tasks:
    state = simulator.state
    seen = np.flatnonzero(sight.seen)
    told = []
    for task, record in zip(seen.tolist(), state.tasks[0, seen], strict=True):
        waits = state.lags[0, task]
        told.append(
            SeenTask(
                task=task,
                x=float(record["x"]),
                y=float(record["y"]),
                weight=float(record["weight"]),
                deadline=int(record["deadline"]),
                place=int(record["place"]),
                waits=[(other, int(waits[other])) for other in np.flatnonzero(waits >= 0).tolist()],
                near=np.flatnonzero(state.near[0, task] & sight.seen).tolist(),
            )
        )
    return Tasks(tasks=told)


def _estimates(simulator: MurseSimulator, viewer: int, sight: Sight) -> Estimates:
    heard = np.flatnonzero(sight.heard).tolist()
    told = []
    for task in np.flatnonzero(sight.seen).tolist():
        pairs = simulator.state.pairs[0, task][_ESTIMATED]
        told.append((task, [Estimate(agent, *values) for agent, values in zip(heard, pairs[heard].tolist())]))  # noqa: B905
    return Estimates(tasks=told)


_ESTIMATED = ["planned", "mean", "spread", "repetitions"]


def _commitments(simulator: MurseSimulator, viewer: int, sight: Sight) -> Commitments:
    state, row = simulator.state, simulator.state.rows[0]
    heard = np.flatnonzero(sight.heard).tolist()
    agents = [
        HeardAgent(agent, int(state.agents["last_task"][0, agent]), *standpoint(state, 0, agent)) for agent in heard
    ]
    taken = []
    for task in state.order[0, : row["dispatched"]].tolist():
        if sight.known[task]:
            owner, committed = int(state.tasks["agent"][0, task]), int(state.tasks["committed"][0, task])
            committed = committed if sight.heard[owner] else -1
            taken.append(TakenTask(task, owner, committed, int(sight.start[task]), int(sight.finish[task])))
    listening = heard if not simulator.view.hides else [viewer]
    free = [] if _over(simulator) else [a for a in listening if state.agents["free_at"][0, a] <= row["clock"]]
    return Commitments(agents=agents, taken=taken, free=free)


_WRITERS = {TASKS: _tasks, ESTIMATES: _estimates, COMMITMENTS: _commitments}

TELEMETRY = MurseTelemetry()

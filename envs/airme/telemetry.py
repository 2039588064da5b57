"""AirME on the wire: what the world says hour by hour, and the local state a crew builds from what it may hear.

Channels, each with the newest state as its payload (msgpack):

    plane/<sector>/now       the sector's planes as they are, for the crew whose sector it is
                             (and, where the view has no staleness, for all crews within reach)
    plane/<sector>/delayed   the same, as they were `staleness` hours ago, for the other crews within reach
    crew/<id>/status         the crew's job and its choice of this hour, for all crews within comm
    crew/<id>/memory           what that crew alone learnt of planes: from a conflict, or from a repair of its own

The payloads are those of marl_sched.envs.airme.messages; a crew's side is marl_sched.envs.airme.local_state.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from typing import cast

import numpy as np

from marl_sched.envs.airme import graph
from marl_sched.envs.airme.local_state import AirmeLocalState
from marl_sched.envs.airme.messages import (
    CHOSEN,
    NOBODY,
    REPAIRED,
    CrewStatus,
    Frame,
    KnownPlane,
    Memory,
    PlaneStatus,
    Sector,
    decode,
    encode,
)
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.state import CREW, OBJECTIVES, PLANE, State
from marl_sched.simulation import Observation

Which = Sequence[int] | None  # sectors or crews, None: all
_SEEN = tuple(name for name in PlaneStatus.__struct_fields__ if name not in ("slot", "in_hand"))
_TOLD = np.dtype(
    [
        (name, PLANE.fields[name][0] if PLANE.fields and name in PLANE.fields else np.int64)
        for name in PlaneStatus.__struct_fields__
    ]
)


def _statuses(planes: np.ndarray, slots: np.ndarray, *, with_chosen: bool) -> list[PlaneStatus]:
    """The planes, PLANE (P + 1,), in those slots as they go on the wire; a choice of this hour only `with_chosen`.

    Plain tuples stand for the structs, which encode alike: there are hundreds of them every hour.
    """
    chosen, told = planes[slots], np.empty(len(slots), _TOLD)
    for name in _SEEN:
        told[name] = chosen[name]
    told["slot"] = slots
    told["in_hand"] = np.where((chosen["chosen"] >= 0) & with_chosen, CHOSEN, NOBODY)
    told["in_hand"][chosen["crew"] >= 0] = REPAIRED
    return cast(list[PlaneStatus], told.tolist())


class AirmeTelemetry:
    """The world's side, and the way to an agent's; see marl_sched.domain_parts.Telemetry."""

    time_unit = "hour"

    def frame(self, simulator: AirmeSimulator) -> bytes:
        """Sizes, padding, usage and view of row 0."""
        reach, comm, staleness = simulator.limits[0].tolist()
        row = simulator.state.rows[0]
        return encode(
            Frame(
                n_planes=int(row["n_planes"]),
                n_crews=int(row["n_crews"]),
                max_planes=simulator.max_actions - 1,
                max_crews=simulator.max_agents,
                usage=simulator.rules.usage.tolist(),
                reach=reach,
                comm=comm,
                staleness=staleness,
            )
        )

    def messages(self, simulator: AirmeSimulator, channels: Collection[str] | None = None) -> dict[str, bytes]:
        """Every sector now and delayed, every crew's status and memory; only `channels` if they are given."""
        said: dict[str, bytes] = {}
        for kind, write in _WRITERS.items():
            if channels is None:
                said |= write(simulator, None)
            elif chosen := [int(match[1]) for c in channels if (match := kind.fullmatch(c))]:
                said |= write(simulator, sorted(chosen))
        return said

    def turn_channels(self, simulator: AirmeSimulator, agent: int) -> list[str]:
        """What a crew chose, and what it learnt if that was impossible; planes change when the hour passes."""
        channels = [f"crew/{agent}/status"]
        return [*channels, f"crew/{agent}/memory"] if simulator.limits[0, 2] else channels

    def series(self, simulator: AirmeSimulator) -> dict[str, list[float]]:
        """Profit, revenue and availability of every hour so far."""
        hours = int(simulator.time[0])
        return {name: simulator.state.series[0, :hours, k].tolist() for k, name in enumerate(OBJECTIVES)}

    def local_state(self, frame: bytes, agent: int) -> AirmeLocalState:
        """A crew's empty local state."""
        return AirmeLocalState(decode(frame, Frame), agent, _observe)


def _sectors(planes: np.ndarray, hour: int, age: str, simulator: AirmeSimulator, which: Which) -> dict[str, bytes]:
    """The payloads of sectors, all if `which` is None, as they were at the start of `hour`."""
    row = simulator.state.rows[0]
    n_planes, n_crews = int(row["n_planes"]), int(row["n_crews"])
    told = _statuses(planes, np.arange(1, n_planes + 1), with_chosen=False)
    sectors = range(n_crews) if which is None else which
    return {f"plane/{s}/{age}": encode(Sector(hour=hour, planes=told[s::n_crews])) for s in sectors}


def _now(simulator: AirmeSimulator, which: Which) -> dict[str, bytes]:
    return _sectors(simulator.state.planes[0], int(simulator.time[0]), "now", simulator, which)


def _delayed(simulator: AirmeSimulator, which: Which) -> dict[str, bytes]:
    if not simulator.limits[0, 2]:
        return {}
    hour, past = _snapshot_hour(simulator), simulator.state.past
    return _sectors(past[0, hour % past.shape[1]], hour, "delayed", simulator, which)


def _crew_statuses(simulator: AirmeSimulator, which: Which) -> dict[str, bytes]:
    hour, crews = int(simulator.time[0]), simulator.state.crews[0]
    said = {}
    for crew in range(int(simulator.n_agents[0])) if which is None else which:
        record = dict(zip(CREW.names or (), crews[crew].item(), strict=True))
        said[f"crew/{crew}/status"] = encode(CrewStatus(hour=hour, **record))
    return said


def _memories(simulator: AirmeSimulator, which: Which) -> dict[str, bytes]:
    if not simulator.limits[0, 2]:
        return {}
    state, said = simulator.state, {}
    hours = state.private_memory_at[0, : int(simulator.n_agents[0])]
    kept = np.asarray(hours >= _snapshot_hour(simulator))
    knowing = set(np.nonzero(kept)[0].tolist())
    for crew in range(len(hours)) if which is None else which:
        planes: list[KnownPlane] = []
        if crew in knowing:
            slots = np.flatnonzero(kept[crew])
            told = _statuses(state.private_memory[0, crew], slots, with_chosen=True)
            planes = [KnownPlane(*pair) for pair in zip(hours[crew, slots].tolist(), told, strict=True)]
        said[f"crew/{crew}/memory"] = encode(Memory(planes=planes))
    return said


def _snapshot_hour(simulator: AirmeSimulator) -> int:
    """The hour that delayed snapshots are of."""
    return max(0, int(simulator.time[0]) - int(simulator.limits[0, 2]))


_WRITERS: dict[re.Pattern[str], Callable[[AirmeSimulator, Which], dict[str, bytes]]] = {
    re.compile(r"plane/(\d+)/now"): _now,
    re.compile(r"plane/(\d+)/delayed"): _delayed,
    re.compile(r"crew/(\d+)/status"): _crew_statuses,
    re.compile(r"crew/(\d+)/memory"): _memories,
}


def _observe(state: State, usage: np.ndarray, agent: int, limits: np.ndarray, out: Observation) -> None:
    """What the kernel that observes the true state sees in a local one; see local_state.Observe."""
    arrays = graph.Arrays(*[out[name] for name in graph.Arrays._fields])
    graph.observe(state, usage, np.array([agent], np.int64), limits, arrays)


TELEMETRY = AirmeTelemetry()

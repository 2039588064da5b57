"""AirME on the wire: what the world says hour by hour, and the local state a crew builds from what it may hear.

Channels, each with the newest state as its payload (msgpack):

    plane/<sector>/now       the sector's planes as they are, for the crew whose sector it is
                             (and, where the view has no staleness, for all crews within reach)
    plane/<sector>/delayed   the same, as they were `staleness` hours ago, for the other crews within reach
    crew/<id>/status         the crew's job and its choice of this hour, for all crews within comm
    crew/<id>/memory           what that crew alone learnt of planes: from a conflict, or from a repair of its own

A local state is a simulator state of one row that is filled in only where the crew heard something and is zero
elsewhere. It is read by the kernel that observes the true state, so that what a deployed crew sees is equal to
the simulator's observation to the last bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from operator import itemgetter
from typing import Annotated, Any, TypeVar, cast

import msgspec
import numpy as np

from marl_sched.envs.airme import graph
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.envs.airme.state import CREW, OBJECTIVES, PLANE, ROW, State
from marl_sched.envs.airme.views import EVERYWHERE, ring_distance
from marl_sched.errors import InvalidMessageError
from marl_sched.simulation import Observation

Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Size = Annotated[int, msgspec.Meta(ge=1, lt=2**20)]
Hour = Annotated[int, msgspec.Meta(ge=0, lt=2**40)]

NOBODY, CHOSEN, REPAIRED = 0, 1, 2  # who has a plane in hand: nobody, a crew that chose it this hour, a repairer
_SECTOR = re.compile(r"plane/(\d+)/(now|delayed)")
_CREW_CHANNEL = re.compile(r"crew/(\d+)/(status|memory)")


class _Payload(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """A payload names its type and the type's version, so that a reader of another version refuses it."""


class Frame(_Payload, tag="airme.frame.1", frozen=True):
    """What every crew is told at the start: the sizes, the types' usage and the view."""

    n_planes: Size
    n_crews: Size
    max_planes: Size  # the padding
    max_crews: Size
    usage: Annotated[list[Annotated[float, msgspec.Meta(ge=0, le=1)]], msgspec.Meta(min_length=1)]
    reach: Count
    comm: Count
    staleness: Count  # hours


class PlaneStatus(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What there is to see of a plane; names and units as in dynamics.PLANE."""

    slot: Size
    kind: Count
    income: float
    hours: Count
    landings: Count
    broken: bool
    in_hand: Annotated[int, msgspec.Meta(ge=NOBODY, le=REPAIRED)]
    job_hours: Count
    job_cost: float
    job_done: Count
    mission_hours: Count
    mission_done: Count


_SEEN = tuple(name for name in PlaneStatus.__struct_fields__ if name not in ("slot", "in_hand"))
_TOLD = np.dtype(
    [
        (name, PLANE.fields[name][0] if PLANE.fields and name in PLANE.fields else np.int64)
        for name in PlaneStatus.__struct_fields__
    ]
)


class Sector(_Payload, tag="airme.sector.1", frozen=True):
    """A sector's planes as they were at the start of `hour`."""

    hour: Hour
    planes: list[PlaneStatus]


class CrewStatus(_Payload, tag="airme.crew.1", frozen=True):
    """A crew at a decision epoch of `hour`; see dynamics.CREW."""

    hour: Hour
    plane: Count
    job_hours: Count
    job_done: Count
    choice: Annotated[int, msgspec.Meta(ge=-1, lt=2**31)]


class KnownPlane(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A plane as a crew learnt it to be at `hour`."""

    hour: Hour
    plane: PlaneStatus


class Memory(_Payload, tag="airme.memory.1", frozen=True):
    """All that a crew learnt by itself and that is not older than the delayed snapshots of other sectors."""

    planes: list[KnownPlane]


P = TypeVar("P", bound=_Payload)
Which = Sequence[int] | None  # sectors or crews, None: all
_encode = msgspec.msgpack.Encoder().encode


def _decode(payload: bytes, kind: type[P]) -> P:
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessageError(f"not a message of type {kind.__struct_config__.tag}: {error}") from error


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


def _restore(planes: np.ndarray, statuses: Sequence[PlaneStatus]) -> None:
    """Write statuses into planes, PLANE (P + 1,). Who has one in hand stays unknown: crew 0 stands for anybody."""
    for status in statuses:
        told = dict(zip(PlaneStatus.__struct_fields__, msgspec.structs.astuple(status), strict=True))
        told["crew"] = 0 if status.in_hand == REPAIRED else -1
        told["chosen"] = 0 if status.in_hand == CHOSEN else -1
        planes[status.slot] = _in_order(told)  # a record in one piece: field by field it takes ten times as long


_in_order = itemgetter(*(PLANE.names or ()))


def _sector_slots(sector: int, n_planes: int, n_crews: int) -> range:
    return range(sector + 1, n_planes + 1, n_crews)


class AirmeTelemetry:
    """The world's side, and the way to an agent's; see marl_sched.domain.Telemetry."""

    time_unit = "hour"

    def frame(self, simulator: AirmeSimulator) -> bytes:
        """Sizes, padding, usage and view of row 0."""
        reach, comm, staleness = simulator.limits[0].tolist()
        row = simulator.state.rows[0]
        return _encode(
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
        return AirmeLocalState(_decode(frame, Frame), agent)


def _sectors(planes: np.ndarray, hour: int, age: str, simulator: AirmeSimulator, which: Which) -> dict[str, bytes]:
    """The payloads of sectors, all if `which` is None, as they were at the start of `hour`."""
    row = simulator.state.rows[0]
    n_planes, n_crews = int(row["n_planes"]), int(row["n_crews"])
    told = _statuses(planes, np.arange(1, n_planes + 1), with_chosen=False)
    sectors = range(n_crews) if which is None else which
    return {f"plane/{s}/{age}": _encode(Sector(hour=hour, planes=told[s::n_crews])) for s in sectors}


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
        said[f"crew/{crew}/status"] = _encode(CrewStatus(hour=hour, **record))
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
        said[f"crew/{crew}/memory"] = _encode(Memory(planes=planes))
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


class AirmeLocalState:
    """What one crew knows; see marl_sched.domain.LocalState."""

    def __init__(self, frame: Frame, agent: int) -> None:
        if not 0 <= agent < frame.n_crews:
            raise InvalidMessageError(f"crew {agent} does not exist: the problem has crews 0 to {frame.n_crews - 1}")
        if frame.n_crews > frame.max_crews or frame.n_planes > frame.max_planes:
            raise InvalidMessageError("frame: more crews or planes than the padding holds")
        self._frame, self._agent = frame, agent
        self._usage = np.array(frame.usage)
        self._sectors = {
            sector: "now" if sector == agent or frame.staleness == 0 else "delayed"
            for sector in range(frame.n_crews)
            if frame.reach >= EVERYWHERE or ring_distance(agent, sector, frame.n_crews) <= frame.reach
        }
        self._crews = [c for c in range(frame.n_crews) if ring_distance(agent, c, frame.n_crews) <= frame.comm]
        channels = [f"plane/{sector}/{age}" for sector, age in self._sectors.items()]
        channels += [f"crew/{crew}/status" for crew in self._crews]
        channels += [f"crew/{agent}/memory"] if frame.staleness else []
        self.channels = tuple(sorted(channels))
        self._limits = np.array([[frame.reach, frame.comm, frame.staleness]])
        self._state = _empty_state(frame)
        sizes = {"plane": frame.max_planes + 1, "crew": frame.max_crews}
        arrays = graph.graph_spec(len(frame.usage)).arrays(sizes)
        self._observation: Observation = {name: spec.empty(1) for name, spec in arrays.items()}

    def hear(self, channel: str, payload: bytes) -> None:
        """Take in a channel's newest payload; see LocalState.hear."""
        if channel not in self.channels:
            raise InvalidMessageError(f"{channel}: not a channel that crew {self._agent} hears")
        if match := _SECTOR.fullmatch(channel):
            self._hear_sector(int(match[1]), match[2] == "now", _decode(payload, Sector))
        elif match := _CREW_CHANNEL.fullmatch(channel):
            if match[2] == "status":
                self._hear_crew(int(match[1]), _decode(payload, CrewStatus))
            else:
                self._hear_memory(_decode(payload, Memory))

    def _hear_sector(self, sector: int, now: bool, said: Sector) -> None:
        frame, state = self._frame, self._state
        slots = list(_sector_slots(sector, frame.n_planes, frame.n_crews))
        if [plane.slot for plane in said.planes] != slots:
            raise InvalidMessageError(f"sector {sector}: expected the planes in slots {slots}")
        self._check(said.planes)
        planes = state.planes[0] if now else state.past[0, said.hour % (frame.staleness + 1)]
        _restore(planes, said.planes)

    def _hear_crew(self, crew: int, said: CrewStatus) -> None:
        if max(said.plane, said.choice) > self._frame.n_planes:
            raise InvalidMessageError(f"crew {crew}: a plane beyond the {self._frame.n_planes} that there are")
        record = self._state.crews[0, crew]
        for name in CREW.names or ():
            record[name] = getattr(said, name)
        if crew == self._agent:
            self._state.rows["time"] = said.hour  # its own clock: the hour in which the crew decides

    def _hear_memory(self, said: Memory) -> None:
        self._check([told.plane for told in said.planes])
        told, told_at = self._state.private_memory[0, self._agent], self._state.private_memory_at[0, self._agent]
        _restore(told, [item.plane for item in said.planes])
        told_at[:] = -1
        for item in said.planes:
            told_at[item.plane.slot] = item.hour

    def _check(self, planes: list[PlaneStatus]) -> None:
        for plane in planes:
            if plane.slot > self._frame.n_planes or plane.kind >= len(self._usage):
                raise InvalidMessageError(f"plane {plane.slot} of type {plane.kind}: there is no such plane or type")

    def observe(self) -> Observation:
        """The crew's observation; its arrays are written anew by every call."""
        out = graph.Arrays(*[self._observation[name] for name in graph.Arrays._fields])
        agents = np.array([self._agent], np.int64)
        graph.observe(self._state, self._usage, agents, self._limits, out)
        return self._observation

    def simulator(self) -> None:
        """No scheduler of AirME plans from a whole state."""


def _empty_state(frame: Frame) -> State:
    """A state of one row in which nothing is known but the sizes; it never passes an hour."""
    slots = frame.max_planes + 1
    memory = (1, frame.max_crews, slots) if frame.staleness else (0, 0, 0)
    rows = np.zeros(1, ROW)
    rows["n_planes"], rows["n_crews"] = frame.n_planes, frame.n_crews
    unknown: Any = {"crew": -1, "chosen": -1}
    state = State(
        rows=rows,
        planes=np.zeros((1, slots), PLANE),
        crews=np.zeros((1, frame.max_crews), CREW),
        series=np.zeros((1, 0, len(OBJECTIVES))),
        timeline=np.zeros((0, 0, 0), np.uint8),
        jobs=np.zeros((0, 0, 0), np.int32),
        work=np.zeros((0, 0, 0), np.int64),
        past=np.zeros((1, frame.staleness + 1 if frame.staleness else 0, slots), PLANE),
        private_memory=np.zeros(memory, PLANE),
        private_memory_at=np.full(memory, -1, np.int64),
    )
    for planes in (state.planes, state.past, state.private_memory):
        for name, value in unknown.items():
            planes[name] = value
    return state


TELEMETRY = AirmeTelemetry()

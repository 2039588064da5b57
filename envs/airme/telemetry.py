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
from typing import Annotated, Any, TypeVar

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
_encode = msgspec.msgpack.Encoder().encode


def _decode(payload: bytes, kind: type[P]) -> P:
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessageError(f"not a message of type {kind.__struct_config__.tag}: {error}") from error


def _statuses(planes: np.ndarray, slots: range, with_chosen: bool) -> list[PlaneStatus]:
    """Planes, PLANE (P + 1,), as they go on the wire; a choice of this hour is told only `with_chosen`."""
    statuses = []
    for slot, values in zip(slots, planes[slots.start : slots.stop : slots.step].tolist(), strict=True):
        plane = dict(zip(PLANE.names or (), values, strict=True))
        chosen = CHOSEN if with_chosen and plane["chosen"] >= 0 else NOBODY
        in_hand = REPAIRED if plane["crew"] >= 0 else chosen
        statuses.append(PlaneStatus(slot=slot, in_hand=in_hand, **{name: plane[name] for name in _SEEN}))
    return statuses


def _restore(planes: np.ndarray, status: PlaneStatus) -> None:
    """Write a status into planes, PLANE (P + 1,). Who has it in hand stays unknown: crew 0 stands for anybody."""
    plane = planes[status.slot]
    for name in _SEEN:
        plane[name] = getattr(status, name)
    plane["crew"] = 0 if status.in_hand == REPAIRED else -1
    plane["chosen"] = 0 if status.in_hand == CHOSEN else -1


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

    def messages(self, simulator: AirmeSimulator) -> dict[str, bytes]:
        """Every sector now and delayed, every crew's status and memory."""
        state, staleness = simulator.state, int(simulator.limits[0, 2])
        n_planes, n_crews = int(state.rows[0]["n_planes"]), int(state.rows[0]["n_crews"])
        now = int(state.rows[0]["time"])
        snapshot_hour = max(0, now - staleness)
        said: dict[str, bytes] = {}
        for sector in range(n_crews):
            slots = _sector_slots(sector, n_planes, n_crews)
            planes = _statuses(state.planes[0], slots, with_chosen=False)
            said[f"plane/{sector}/now"] = _encode(Sector(hour=now, planes=planes))
            if staleness:
                planes = _statuses(state.past[0, snapshot_hour % state.past.shape[1]], slots, with_chosen=False)
                said[f"plane/{sector}/delayed"] = _encode(Sector(hour=snapshot_hour, planes=planes))
        for crew in range(n_crews):
            record = {name: int(state.crews[0, crew][name]) for name in CREW.names or ()}
            said[f"crew/{crew}/status"] = _encode(CrewStatus(hour=now, **record))
            if staleness:
                said[f"crew/{crew}/memory"] = _encode(_memory(state, crew, snapshot_hour))
        return said

    def series(self, simulator: AirmeSimulator) -> dict[str, list[float]]:
        """Profit, revenue and availability of every hour so far."""
        hours = int(simulator.time[0])
        return {name: simulator.state.series[0, :hours, k].tolist() for k, name in enumerate(OBJECTIVES)}

    def local_state(self, frame: bytes, agent: int) -> AirmeLocalState:
        """A crew's empty local state."""
        return AirmeLocalState(_decode(frame, Frame), agent)


def _memory(state: State, crew: int, snapshot_hour: int) -> Memory:
    kept = [int(slot) for slot in np.flatnonzero(state.private_memory_at[0, crew] >= snapshot_hour)]
    hours = state.private_memory_at[0, crew, kept].tolist()
    planes = [_statuses(state.private_memory[0, crew], range(slot, slot + 1), with_chosen=True)[0] for slot in kept]
    return Memory(planes=[KnownPlane(hour, plane) for hour, plane in zip(hours, planes, strict=True)])


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
        for plane in said.planes:
            _restore(planes, plane)

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
        told_at[:] = -1
        for item in said.planes:
            _restore(told, item.plane)
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

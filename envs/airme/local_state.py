"""What one deployed crew knows, built from what it hears (marl_sched.envs.airme.telemetry).

A local state is a simulator state of one row that is filled in only where the crew heard something and is zero
elsewhere. It is read by the kernel that observes the true state, or by its equal in NumPy
(marl_sched.envs.airme.numpy_view), so that what a deployed crew sees is equal to the simulator's observation to the
last bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from marl_sched.envs.airme.features import graph_spec
from marl_sched.envs.airme.messages import (
    CHOSEN,
    REPAIRED,
    CrewStatus,
    Frame,
    Memory,
    PlaneStatus,
    Sector,
    decode,
    sector_slots,
)
from marl_sched.envs.airme.state import CREW, EVERYWHERE, OBJECTIVES, PLANE, ROW, State
from marl_sched.errors import InvalidMessageError

Observation = dict[str, np.ndarray]
Observe = Callable[
    [State, np.ndarray, int, np.ndarray, Observation], None
]  # state, usage, agent, limits, what it writes
_SECTOR = re.compile(r"plane/(\d+)/(now|delayed)")
_CREW_CHANNEL = re.compile(r"crew/(\d+)/(status|memory)")


def apart(a: int, b: int, n_crews: int) -> int:
    """Steps between two crews on the ring, the shorter way round."""
    steps = abs(a - b)
    return min(steps, n_crews - steps)


def _restore(planes: np.ndarray, statuses: Sequence[PlaneStatus]) -> None:
    """Write statuses into planes, PLANE (P + 1,). Who has one in hand stays unknown: crew 0 stands for anybody."""
    for told in statuses:  # in the order of PLANE: a record in one piece takes a tenth of the time of its fields
        planes[told.slot] = (
            told.income,
            told.job_cost,
            told.hours,
            told.landings,
            told.kind,
            0 if told.in_hand == REPAIRED else -1,
            told.job_hours,
            told.job_done,
            told.mission_hours,
            told.mission_done,
            0 if told.in_hand == CHOSEN else -1,
            told.broken,
        )


class AirmeLocalState:
    """What one crew knows; see marl_sched.domain_parts.LocalState."""

    def __init__(self, frame: Frame, agent: int, observe: Observe) -> None:
        if not 0 <= agent < frame.n_crews:
            raise InvalidMessageError(f"crew {agent} does not exist: the problem has crews 0 to {frame.n_crews - 1}")
        if frame.n_crews > frame.max_crews or frame.n_planes > frame.max_planes:
            raise InvalidMessageError("frame: more crews or planes than the padding holds")
        self._frame, self._agent, self._observe = frame, agent, observe
        self._usage = np.array(frame.usage)
        self._sectors = {
            sector: "now" if sector == agent or frame.staleness == 0 else "delayed"
            for sector in range(frame.n_crews)
            if frame.reach >= EVERYWHERE or apart(agent, sector, frame.n_crews) <= frame.reach
        }
        self._crews = [c for c in range(frame.n_crews) if apart(agent, c, frame.n_crews) <= frame.comm]
        channels = [f"plane/{sector}/{age}" for sector, age in self._sectors.items()]
        channels += [f"crew/{crew}/status" for crew in self._crews]
        channels += [f"crew/{agent}/memory"] if frame.staleness else []
        self.channels = tuple(sorted(channels))
        self._hears = frozenset(channels)
        self._limits = np.array([[frame.reach, frame.comm, frame.staleness]])
        self._state = _empty_state(frame)
        sizes = {"plane": frame.max_planes + 1, "crew": frame.max_crews}
        arrays = graph_spec(len(frame.usage)).arrays(sizes)
        self._observation: Observation = {name: spec.empty(1) for name, spec in arrays.items()}

    def hear(self, channel: str, payload: bytes) -> None:
        """Take in a channel's newest payload; see LocalState.hear."""
        if channel not in self._hears:
            raise InvalidMessageError(f"{channel}: not a channel that crew {self._agent} hears")
        if match := _SECTOR.fullmatch(channel):
            self._hear_sector(int(match[1]), match[2] == "now", decode(payload, Sector))
        elif match := _CREW_CHANNEL.fullmatch(channel):
            if match[2] == "status":
                self._hear_crew(int(match[1]), decode(payload, CrewStatus))
            else:
                self._hear_memory(decode(payload, Memory))

    def _hear_sector(self, sector: int, now: bool, said: Sector) -> None:
        frame, state = self._frame, self._state
        slots = list(sector_slots(sector, frame.n_planes, frame.n_crews))
        if [plane.slot for plane in said.planes] != slots:
            raise InvalidMessageError(f"sector {sector}: expected the planes in slots {slots}")
        self._check(said.planes)
        planes = state.planes[0] if now else state.past[0, said.hour % (frame.staleness + 1)]
        _restore(planes, said.planes)

    def _hear_crew(self, crew: int, said: CrewStatus) -> None:
        if max(said.plane, said.choice) > self._frame.n_planes:
            raise InvalidMessageError(f"crew {crew}: a plane beyond the {self._frame.n_planes} that there are")
        self._state.crews[0, crew] = (said.plane, said.job_hours, said.job_done, said.choice)  # in the order of CREW
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
        self._observe(self._state, self._usage, self._agent, self._limits, self._observation)
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

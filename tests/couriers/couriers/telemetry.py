"""The state on the wire: a channel per job and per courier; a courier hears those within its view's reach."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from couriers import graph
from marl_sched.errors import InvalidMessageError
from marl_sched.simulation import Observation

if TYPE_CHECKING:
    from couriers.simulator import CouriersSimulator


class Frame(msgspec.Struct, tag="couriers.frame.1", forbid_unknown_fields=True):
    """Sizes with their padding, the reach of the view, and where everything is."""

    max_jobs: int
    max_couriers: int
    reach: int
    places: list[int]
    homes: list[int]


class Said(msgspec.Struct, tag="couriers.state.1", forbid_unknown_fields=True):
    """A record of graph.JOB or graph.COURIER on a day, and how many jobs there are on it."""

    day: int
    present: int
    values: list[int]


class CouriersTelemetry:
    """The world's side, and the way to an agent's; see marl_sched.domain_parts.Telemetry."""

    time_unit = "day"

    def frame(self, simulator: CouriersSimulator) -> bytes:
        """What everybody is told at the start."""
        instance = simulator.instances[0]
        return msgspec.msgpack.encode(
            Frame(
                max_jobs=simulator.max_actions - 1,
                max_couriers=simulator.max_agents,
                reach=simulator.view.reach,
                places=[job.place for job in instance.jobs],
                homes=[courier.home for courier in instance.couriers],
            )
        )

    def messages(self, simulator: CouriersSimulator, channels: Collection[str] | None = None) -> dict[str, bytes]:
        """Every job and every courier as it is, or those of `channels` alone."""
        said: dict[str, bytes] = {}
        day, present = int(simulator.time[0]), int(simulator.jobs["there"][0].sum())
        for j in range(1, len(simulator.instances[0].jobs) + 1):
            values = [int(value) for value in simulator.jobs[0, j].item()]
            said[f"job/{j}"] = msgspec.msgpack.encode(Said(day=day, present=present, values=values))
        for c in range(int(simulator.n_agents[0])):
            values = [int(value) for value in simulator.couriers[0, c].item()]
            said[f"courier/{c}/status"] = msgspec.msgpack.encode(Said(day=day, present=present, values=values))
        return {channel: payload for channel, payload in said.items() if channels is None or channel in channels}

    def turn_channels(self, simulator: CouriersSimulator, agent: int) -> list[str]:
        """What a courier chose; jobs are taken at the end of the day."""
        return [f"courier/{agent}/status"]

    def series(self, simulator: CouriersSimulator) -> dict[str, list[float]]:
        """Nothing is kept day by day."""
        return {}

    def local_state(self, frame: bytes, agent: int) -> CouriersLocalState:
        """A courier's empty local state."""
        return CouriersLocalState(_decode(frame, Frame), agent)


class CouriersLocalState:
    """What one courier knows; see marl_sched.domain_parts.LocalState."""

    def __init__(self, frame: Frame, agent: int) -> None:
        if not 0 <= agent < len(frame.homes):
            raise InvalidMessageError(f"courier {agent} does not exist: there are {len(frame.homes)}")
        self._frame, self._agent, self._day, self._present = frame, agent, 0, 0
        self._jobs = np.zeros(frame.max_jobs + 1, graph.JOB)
        self._couriers = np.zeros(frame.max_couriers, graph.COURIER)
        home = frame.homes[agent]
        jobs = [f"job/{j}" for j, place in enumerate(frame.places, start=1) if abs(place - home) <= frame.reach]
        near = [f"courier/{c}/status" for c, other in enumerate(frame.homes) if abs(other - home) <= frame.reach]
        self.channels = tuple(sorted([*jobs, *near]))
        self._arrays = graph.GRAPH.arrays({"job": frame.max_jobs + 1, "courier": frame.max_couriers})

    def hear(self, channel: str, payload: bytes) -> None:
        """Take in a channel's newest payload."""
        if channel not in self.channels:
            raise InvalidMessageError(f"{channel}: not a channel that courier {self._agent} hears")
        said = _decode(payload, Said)
        kind, index = channel.split("/")[:2]
        table = self._jobs if kind == "job" else self._couriers
        if len(said.values) != len(table.dtype.names or ()):
            raise InvalidMessageError(f"{channel}: expected {len(table.dtype.names or ())} values")
        table[int(index)] = tuple(said.values)
        if channel == f"courier/{self._agent}/status":
            self._day, self._present = said.day, said.present

    def observe(self) -> Observation:
        """The courier's observation with B = 1."""
        out = {name: spec.empty(1) for name, spec in self._arrays.items()}
        arrays = {name: array[0, ...] for name, array in out.items()}
        graph.write(self._jobs, self._couriers, self._day, self._agent, self._frame.reach, self._present, arrays)
        return out

    def simulator(self) -> None:
        """No scheduler of couriers plans from a whole state."""


def _decode(payload: bytes, kind: type) -> msgspec.Struct:
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessageError(f"not a {kind.__name__}: {error}") from error


TELEMETRY = CouriersTelemetry()

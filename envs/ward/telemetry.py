"""The ward on the wire: what the world says every quarter of an hour, and what a nurse makes of what she may hear.

Channels, each with the newest state as its payload (msgpack):

    section/<id>          patients who wait or lie in the section, and who lies in its beds, for nurses within reach
    nurse/<id>/status     load, present task and choice of a nurse, for nurses within comm

A local state is a simulator state of one row that is filled in only where the nurse heard something. It is read by the
kernel that observes the true state, so that what a deployed nurse sees is equal to the simulator's observation to the
last bit. Who will arrive is told to nobody.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Annotated, TypeVar

import msgspec
import numpy as np

from marl_sched.envs.ward import graph
from marl_sched.envs.ward.dynamics import NURSE, RECOVERY, State
from marl_sched.envs.ward.features import GRAPH
from marl_sched.envs.ward.simulator import new_state
from marl_sched.errors import InvalidMessageError
from marl_sched.simulation import Observation

if TYPE_CHECKING:
    from marl_sched.envs.ward.simulator import WardSimulator

Count = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
Index = Annotated[int, msgspec.Meta(ge=-1, lt=2**31)]  # -1: none
Size = Annotated[int, msgspec.Meta(ge=1, lt=2**20)]


class _Payload(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """A payload names its type and the type's version, so that a reader of another version refuses it."""


class Frame(_Payload, tag="ward.frame.1", frozen=True):
    """What every nurse is told at the start: sizes with their padding, the view, and where everything is."""

    n_patients: Size
    max_patients: Size
    max_nurses: Size
    max_beds: Size
    reach: Count
    comm: Count
    homes: Annotated[list[Count], msgspec.Meta(min_length=1)]
    beds: Annotated[list[Count], msgspec.Meta(min_length=1)]


class PatientStatus(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What there is to see of a patient; names as in dynamics.PATIENT."""

    slot: Size
    arrival: Count
    first: bool
    high_risk: bool
    stage: Annotated[int, msgspec.Meta(ge=0, le=RECOVERY)]
    bed: Index
    nurse: Index
    attended: bool
    in_hand: bool


class Section(_Payload, tag="ward.section.1", frozen=True):
    """Who is in a section at a quarter of an hour, and the patient, 0 for none, of each of its beds in their order."""

    time: Count
    patients: list[PatientStatus]
    beds: list[Count]


class NurseStatus(_Payload, tag="ward.nurse.1", frozen=True):
    """A nurse at a decision epoch; see dynamics.NURSE. `present` is how many patients there are in the ward."""

    time: Count
    present: Count
    busy: Count
    handling: Count
    patient: Count
    choice: Index
    load: Count
    patients: Count


_OF_PATIENT = tuple(name for name in PatientStatus.__struct_fields__ if name != "slot")
_OF_NURSE = tuple(name for name in NURSE.names or () if name != "home")
P = TypeVar("P", bound=_Payload)
_encode = msgspec.msgpack.Encoder().encode


def _decode(payload: bytes, kind: type[P]) -> P:
    try:
        return msgspec.msgpack.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessageError(f"not a message of type {kind.__struct_config__.tag}: {error}") from error


class WardTelemetry:
    """The world's side, and the way to an agent's; see marl_sched.domain_parts.Telemetry."""

    time_unit = "quarter-hour"

    def frame(self, simulator: WardSimulator) -> bytes:
        """Sizes, padding, view and places of row 0."""
        instance, (reach, comm) = simulator.instances[0], simulator.view.limits
        return _encode(
            Frame(
                n_patients=len(instance.patients),
                max_patients=simulator.max_actions - 1,
                max_nurses=simulator.max_agents,
                max_beds=simulator.state.beds.shape[1],
                reach=reach,
                comm=comm,
                homes=list(instance.nurses),
                beds=list(instance.beds),
            )
        )

    def messages(self, simulator: WardSimulator, channels: Collection[str] | None = None) -> dict[str, bytes]:
        """Every section and every nurse as they are, or those of `channels` alone."""
        instance, state = simulator.instances[0], simulator.state
        time, present = int(state.rows["time"][0]), int(state.rows["present"][0])
        patients, beds = state.patients[0], state.beds[0, : len(instance.beds)]
        said: dict[str, bytes] = {}
        for section in sorted(set(instance.beds)):
            channel = f"section/{section}"
            if channels is not None and channel not in channels:
                continue
            slots = np.flatnonzero(patients["there"] & (patients["section"] == section)).tolist()
            told = [PatientStatus(slot, *(patients[slot][name].item() for name in _OF_PATIENT)) for slot in slots]
            lying = beds["patient"][beds["section"] == section].tolist()
            said[channel] = _encode(Section(time=time, patients=told, beds=lying))
        for n in range(len(instance.nurses)):
            channel = f"nurse/{n}/status"
            if channels is None or channel in channels:
                record = {name: state.nurses[0, n][name].item() for name in _OF_NURSE}
                said[channel] = _encode(NurseStatus(time=time, present=present, **record))
        return said

    def turn_channels(self, simulator: WardSimulator, agent: int) -> list[str]:
        """What a nurse chose; it takes effect when the quarter of an hour passes."""
        return [f"nurse/{agent}/status"]

    def series(self, simulator: WardSimulator) -> dict[str, list[float]]:
        """Nothing is kept quarter by quarter."""
        return {}

    def local_state(self, frame: bytes, agent: int) -> WardLocalState:
        """A nurse's empty local state."""
        return WardLocalState(_decode(frame, Frame), agent)


class WardLocalState:
    """What one nurse knows; see marl_sched.domain_parts.LocalState."""

    def __init__(self, frame: Frame, agent: int) -> None:
        if not 0 <= agent < len(frame.homes):
            raise InvalidMessageError(f"nurse {agent} does not exist: there are {len(frame.homes)}")
        sizes = ("nurses", frame.homes, frame.max_nurses), ("beds", frame.beds, frame.max_beds)
        for name, there, most in (*sizes, ("patients", range(frame.n_patients), frame.max_patients)):
            if len(there) > most:
                raise InvalidMessageError(f"frame: more {name} than the padding holds")
        self._frame, self._agent = frame, agent
        home = frame.homes[agent]
        near = [f"section/{section}" for section in sorted(set(frame.beds)) if abs(section - home) <= frame.reach]
        heard = [f"nurse/{n}/status" for n, other in enumerate(frame.homes) if abs(other - home) <= frame.comm]
        self.channels = tuple(sorted([*near, *heard]))
        self._state = _empty_state(frame)
        sizes_of = {"patient": frame.max_patients + 1, "nurse": frame.max_nurses, "bed": frame.max_beds}
        self._observation: Observation = {
            name: spec.empty(1) for name, spec in GRAPH.arrays(sizes_of).items()
        }  # fmt: skip
        self._limits = np.array([frame.reach, frame.comm])

    def hear(self, channel: str, payload: bytes) -> None:
        """Take in a channel's newest payload; see LocalState.hear."""
        if channel not in self.channels:
            raise InvalidMessageError(f"{channel}: not a channel that nurse {self._agent} hears")
        kind, index = channel.split("/")[:2]
        if kind == "section":
            self._hear_section(int(index), _decode(payload, Section))
        else:
            self._hear_nurse(int(index), _decode(payload, NurseStatus))

    def _hear_section(self, section: int, said: Section) -> None:
        frame, patients = self._frame, self._state.patients[0]
        beds = [k for k, place in enumerate(frame.beds) if place == section]
        if len(said.beds) != len(beds) or max(said.beds, default=0) > frame.n_patients:
            raise InvalidMessageError(f"section {section}: expected {len(beds)} beds with patients that there are")
        for told in said.patients:
            if told.slot > frame.n_patients or told.bed >= len(frame.beds) or told.nurse >= len(frame.homes):
                raise InvalidMessageError(f"section {section}: patient {told.slot}: no such patient, bed or nurse")
        patients["there"][patients["section"] == section] = False
        for told in said.patients:
            patient = patients[told.slot]
            patient["there"], patient["section"] = True, section
            for name in _OF_PATIENT:
                patient[name] = getattr(told, name)
        for k, slot in zip(beds, said.beds, strict=True):
            self._state.beds[0, k]["patient"] = slot

    def _hear_nurse(self, n: int, said: NurseStatus) -> None:
        if max(said.choice, said.patient) > self._frame.n_patients:
            raise InvalidMessageError(f"nurse {n}: a patient beyond the {self._frame.n_patients} that there are")
        for name in _OF_NURSE:
            self._state.nurses[0, n][name] = getattr(said, name)
        if n == self._agent:  # her own clock, and how full the ward is
            self._state.rows["time"], self._state.rows["present"] = said.time, said.present

    def observe(self) -> Observation:
        """The nurse's observation; its arrays are written anew by every call."""
        out = graph.Arrays(*[self._observation[name] for name in graph.Arrays._fields])
        graph.observe(self._state, np.array([self._agent], np.int64), self._limits, out)
        return self._observation

    def simulator(self) -> None:
        """No deployed scheduler of the ward plans from a whole state."""


def _empty_state(frame: Frame) -> State:
    """A state of one row in which nothing is known but sizes and places; no time passes in it."""
    state = new_state(1, frame.max_patients, frame.max_nurses, frame.max_beds, (0, 0, 0))
    state.rows["n_patients"], state.rows["n_nurses"] = frame.n_patients, len(frame.homes)
    state.rows["n_beds"] = len(frame.beds)
    state.nurses["home"][0, : len(frame.homes)] = frame.homes
    state.beds["section"][0, : len(frame.beds)] = frame.beds
    state.patients["bed"] = state.patients["nurse"] = -1
    return state


TELEMETRY = WardTelemetry()

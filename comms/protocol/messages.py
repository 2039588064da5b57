"""What travels between the world and its agents: typed, versioned messages in msgpack.

Every message names its run and the world's epoch: one life of the world's process, from its start to its end. A
message of another run or epoch is dropped, so what a frozen or replaced process still has to say changes nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar, overload

import msgspec

from marl_sched.errors import InvalidMessageError

VERSION = 2  # of the protocol; the tags below carry the version of each message
Natural = Annotated[int, msgspec.Meta(ge=0, lt=2**62)]
Word = Annotated[str, msgspec.Meta(max_length=64)]
Sentence = Annotated[str, msgspec.Meta(max_length=400)]
Counts = Annotated[dict[Word, Natural], msgspec.Meta(max_length=32)]
Phase = Literal["gathering", "running", "standstill", "over"]


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """The tag names a message's type and version: a reader of another version refuses it."""

    run: Word
    epoch: Word


class Frame(Message, tag="frame.2", frozen=True):
    """What an agent needs to build its empty local state, and how often both sides say that they live."""

    env: Word
    agents: Natural
    heartbeat: Annotated[float, msgspec.Meta(gt=0, le=3600)]  # seconds
    problem: bytes  # of the domain's telemetry


class Clock(Message, tag="clock.2", frozen=True):
    """Where the run stands: sent at every change and once a heartbeat; `tick` is simulated time."""

    tick: Natural
    phase: Phase


class News(Message, tag="news.2", frozen=True):
    """A channel's newest state; the sequence counts the states of this channel from 1 in this epoch."""

    channel: Annotated[str, msgspec.Meta(max_length=200)]
    sequence: Natural
    payload: bytes


class Snapshot(Message, tag="snapshot.2", frozen=True):
    """The newest state of all channels of an agent."""

    tick: Natural
    phase: Phase
    channels: list[News]


class SnapshotRequest(Message, tag="snapshot-request.2", frozen=True):
    """Whose channels are asked for."""

    agent: Natural


class Hello(Message, tag="hello.2", frozen=True):
    """An agent is ready to decide; its liveliness token stands already."""

    agent: Natural
    incarnation: Word
    policy: Annotated[str, msgspec.Meta(max_length=1000)]


class Beat(Message, tag="beat.1", frozen=True):
    """An agent lives and has heard of `tick`; what it counted since its start."""

    agent: Natural
    incarnation: Word
    tick: Natural
    counts: Counts


class Goodbye(Message, tag="goodbye.1", frozen=True):
    """An agent leaves: at the end of the run, or for good in the middle of it."""

    agent: Natural
    incarnation: Word
    counts: Counts


class Welcome(Message, tag="welcome.2", frozen=True):
    """The world counts on this incarnation."""

    agent: Natural
    incarnation: Word


Why = Literal["given_up", "unknown", "other_epoch", "taken", "barred"]


class Fenced(Message, tag="fenced.2", frozen=True):
    """The world does not count on this incarnation.

    `given_up`, `unknown`, `other_epoch`: it comes back as another incarnation. `taken`, `barred`: it says hello
    again, another process has its place, or nobody may have it for a while.
    """

    agent: Natural
    incarnation: Word
    why: Why
    reason: Sentence


class Refused(Message, tag="refused.1", frozen=True):
    """What was asked for is impossible, whoever asks again; agents of every version can read this message."""

    reason: Sentence


class Turn(Message, tag="turn.2", frozen=True):
    """An agent is to decide. `noise` is the uniform in [0, 1) of its own sampling stream at this epoch.

    The key of the run's noise is not told: with it an agent could foretell failures.
    """

    tick: Natural
    agent: Natural
    incarnation: Word
    sequence: Natural  # counts this agent's turns from 1
    noise: Annotated[float, msgspec.Meta(ge=0, lt=1)]
    needs: dict[str, Natural]  # channel -> sequence


class Decision(Message, tag="decision.2", frozen=True):
    """The answer to the turn with the same tick, agent, incarnation and sequence.

    `remembered` counts the decisions that the agent's memory held when it chose: 0 for the first with an empty one, as
    at the start of a run or after a restart. None: it decides without a memory.
    """

    tick: Natural
    agent: Natural
    incarnation: Word
    sequence: Natural
    action: Natural
    remembered: Natural | None = None

    def answers(self, turn: Turn) -> bool:
        """Whether this is the answer to that turn, and to no other."""
        mine = (self.epoch, self.tick, self.agent, self.incarnation, self.sequence)
        return mine == (turn.epoch, turn.tick, turn.agent, turn.incarnation, turn.sequence)


class Seen(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An agent as the world sees it: its slot's state, and for how many seconds it has been silent."""

    name: Word
    state: Word
    policy: Annotated[str, msgspec.Meta(max_length=200)]
    turns: Natural
    losses: Natural
    silent: float


class Decided(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What became of a turn: tick, agent, action and outcome."""

    tick: Natural
    agent: Natural
    action: Natural
    outcome: Word


class Observed(Message, tag="observed.1", frozen=True):
    """What observers are told, at every change of the phase or of an agent and once a heartbeat.

    `decisions` counts those of this epoch of the world; `decided` has those since the last message, the newest of them
    if there were very many.
    """

    tick: Natural
    horizon: Natural
    phase: Phase
    unit: Word
    agents: list[Seen]
    decisions: Natural
    decided: list[Decided]
    objectives: dict[Word, float]
    counts: Counts
    last_error: Sentence


class Team(Message, tag="team.1", frozen=True):
    """An operator's order about the team. `request` is a name of the asker's choice; `epoch` may be "" for any.

    `pause` and `resume` the run; `drain`: the agent is not asked any more, what it is at is finished; `readmit`: it is
    asked again, also if it had been barred.
    """

    request: Word
    kind: Literal["pause", "resume", "drain", "readmit"]
    agent: Natural | None = None


class Work(Message, tag="work.1", frozen=True):
    """An order to change the work of a running plant; it is for the plant to say whether it can.

    `add`: `data` describes the work in the domain's own form; `cancel`, `repeat`, `reprioritise` the work `entity`,
    the latter to `priority`; `at`: simulated time from which it holds, None: now.
    """

    request: Word
    kind: Literal["add", "cancel", "repeat", "reprioritise"]
    entity: Word = ""
    priority: float | None = None
    at: Natural | None = None
    data: bytes = b""


class Operator(Message, tag="operator.1", frozen=True):
    """An order that binds an agent's choices until a simulated time, None: until it is taken back by another.

    `pin`: nobody else takes `action`, and the agent takes nothing else; `forbid`: the agent does not take it; `force`:
    it is the agent's next choice; `hold`: the agent does nothing.
    """

    request: Word
    kind: Literal["pin", "forbid", "force", "hold"]
    agent: Natural
    action: Natural | None = None
    until: Natural | None = None


class Accepted(Message, tag="accepted.1", frozen=True):
    """An order holds from now on."""

    request: Word


class Declined(Message, tag="declined.1", frozen=True):
    """An order changes nothing, and why."""

    request: Word
    reason: Sentence


ToAgent = Turn | Welcome | Fenced | Refused
FromAgent = Hello | Beat | Goodbye

M = TypeVar("M", bound=Message)
_encoder = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    """A message as msgpack."""
    return _encoder.encode(message)


@overload
def decode(payload: bytes, kind: type[M], /) -> M: ...
@overload
def decode(payload: bytes, *kinds: type[Message]) -> Any: ...
def decode(payload: bytes, *kinds: type[Message]) -> Any:
    """The message in `payload`, one of `kinds`; InvalidMessageError if it is anything else."""
    try:
        return _decoder(kinds).decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidMessageError(f"not a {' or '.join(kind.__name__ for kind in kinds)}: {error}") from error


def other_version(payload: bytes, *kinds: type[Message]) -> str | None:
    """`hello.1` if the payload is a message of `kinds` in another version, None if it is anything else."""
    try:
        said = msgspec.msgpack.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    tag = said.get("type") if isinstance(said, Mapping) else None
    match = re.fullmatch(r"([a-z-]{1,40})\.(\d{1,6})", tag) if isinstance(tag, str) else None
    known = {str(kind.__struct_config__.tag).rpartition(".")[::2] for kind in kinds}
    if match is None or (match[1], match[2]) in known or match[1] not in {name for name, _ in known}:
        return None
    return match[0]


_decoders: dict[tuple[type[Message], ...], msgspec.msgpack.Decoder] = {}


def _decoder(kinds: tuple[type[Message], ...]) -> msgspec.msgpack.Decoder:
    if kinds not in _decoders:
        union = kinds[0]
        for kind in kinds[1:]:
            union = union | kind  # type: ignore[assignment]  # a union built at run time
        _decoders[kinds] = msgspec.msgpack.Decoder(union)
    return _decoders[kinds]

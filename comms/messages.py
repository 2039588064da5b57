"""What travels between the world and its agents: typed, versioned messages in msgpack, and the keys they go by.

All keys of a run start with `marl_sched/<run>/`; below, `crew` stands for the domain's name of an agent.

    world/frame              query: what every agent is told at the start (Frame)
    world/snapshot           query: the newest state of the channels that the asking agent may hear (Snapshot)
    world/clock              world to all: the tick and the phase of the run (Clock)
    world/alive              liveliness of the world
    <channel>                world to those who may hear it: a channel of the domain's telemetry (News)
    crew/<id>/turn           world to that agent: Turn, Welcome or Fenced
    crew/<id>/hello          agent to world, until welcomed (Hello)
    crew/<id>/decision       agent to world (Decision)
    crew/<id>/alive/<incarnation>   liveliness of one incarnation of an agent

A turn says which version of each of its channels the agent must hold to decide, so that nothing depends on the
order of delivery; it is sent again until the decision arrives, and an agent that then still lacks a version asks
for the snapshot. A decision carries (tick, agent, incarnation, sequence) and is applied at most once; its commit
is the new state of the agent's own channel, versioned and repaired like every other.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, TypeVar, overload

import msgspec

from marl_sched.errors import InvalidMessageError, InvalidOptionError

Natural = Annotated[int, msgspec.Meta(ge=0, lt=2**62)]
Phase = Literal["gathering", "running", "over"]


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """The tag names a message's type and version: a reader of another version refuses it."""


class Frame(Message, tag="frame.1", frozen=True):
    """What an agent needs to build its empty local state."""

    env: str
    agents: Natural
    problem: bytes  # of the domain's telemetry


class Clock(Message, tag="clock.1", frozen=True):
    """Where the run stands; `tick` is simulated time."""

    tick: Natural
    phase: Phase


class News(Message, tag="news.1", frozen=True):
    """A channel's newest state; the sequence counts the states of this channel from 1."""

    sequence: Natural
    payload: bytes


class Snapshot(Message, tag="snapshot.1", frozen=True):
    """The newest state of all channels of an agent."""

    clock: Clock
    channels: dict[str, News]


class SnapshotRequest(Message, tag="snapshot-request.1", frozen=True):
    """Whose channels are asked for."""

    agent: Natural


class Hello(Message, tag="hello.1", frozen=True):
    """An agent is ready to decide."""

    agent: Natural
    incarnation: str
    policy: str


class Welcome(Message, tag="welcome.1", frozen=True):
    """The world counts on this incarnation."""

    agent: Natural
    incarnation: str


class Fenced(Message, tag="fenced.1", frozen=True):
    """The world does not count on this incarnation; it may come back as another one, if `reason` allows."""

    agent: Natural
    incarnation: str
    reason: str


class Turn(Message, tag="turn.1", frozen=True):
    """An agent is to decide. `noise` is the uniform in [0, 1) of its own sampling stream at this moment.

    The key of the run's noise is not told: with it an agent could foretell failures.
    """

    tick: Natural
    agent: Natural
    incarnation: str
    sequence: Natural  # counts this agent's turns from 1
    noise: Annotated[float, msgspec.Meta(ge=0, lt=1)]
    needs: dict[str, Natural]  # channel -> sequence


class Decision(Message, tag="decision.1", frozen=True):
    """The answer to the turn with the same tick, agent, incarnation and sequence."""

    tick: Natural
    agent: Natural
    incarnation: str
    sequence: Natural
    target: Natural

    def answers(self, turn: Turn) -> bool:
        """Whether this is the answer to that turn, and to no other."""
        mine = (self.tick, self.agent, self.incarnation, self.sequence)
        return mine == (turn.tick, turn.agent, turn.incarnation, turn.sequence)


ToAgent = Turn | Welcome | Fenced

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
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessageError(f"not a {' or '.join(kind.__name__ for kind in kinds)}: {error}") from error


_decoders: dict[tuple[type[Message], ...], msgspec.msgpack.Decoder] = {}


def _decoder(kinds: tuple[type[Message], ...]) -> msgspec.msgpack.Decoder:
    if kinds not in _decoders:
        union = kinds[0]
        for kind in kinds[1:]:
            union = union | kind  # type: ignore[assignment]  # a union built at run time
        _decoders[kinds] = msgspec.msgpack.Decoder(union)
    return _decoders[kinds]


CLOCK, FRAME, SNAPSHOT, WORLD_ALIVE = "world/clock", "world/frame", "world/snapshot", "world/alive"


def run_prefix(run: str) -> str:
    """What all keys of a run start with; InvalidOptionError if the name cannot be part of a key."""
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", run):
        raise InvalidOptionError(f"run: expected 1 to 64 letters, digits, '.', '_' or '-', got {run!r}")
    return f"marl_sched/{run}/"


def kind_of(key: str) -> str:
    """A key without its numbers, for counting: `plane/3/now` is of kind `plane/now`."""
    return "/".join(chunk for chunk in key.split("/") if not chunk.isdigit())


class AgentKeys:
    """The keys by which agents called `prefix` speak and are spoken to."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._pattern = re.compile(rf"{re.escape(prefix)}/(\d+)/(hello|decision|alive)(?:/([^/]+))?")

    def turn(self, agent: int | str) -> str:
        """World to agent."""
        return f"{self._prefix}/{agent}/turn"

    def hello(self, agent: int | str) -> str:
        """Agent to world; `*` for all."""
        return f"{self._prefix}/{agent}/hello"

    def decision(self, agent: int | str) -> str:
        """Agent to world; `*` for all."""
        return f"{self._prefix}/{agent}/decision"

    def alive(self, agent: int | str, incarnation: str) -> str:
        """Liveliness of an agent; `*` for all."""
        return f"{self._prefix}/{agent}/alive/{incarnation}"

    def parse(self, key: str) -> tuple[int, str, str]:
        """(agent, leaf, incarnation or "") of a key that an agent spoke by; InvalidMessageError for others."""
        match = self._pattern.fullmatch(key)
        if match is None:
            raise InvalidMessageError(f"{key}: not a key of an agent")
        return int(match[1]), match[2], match[3] or ""

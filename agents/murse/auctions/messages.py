"""What agents say in an auction, as typed messages packed by MessagePack."""

from __future__ import annotations

import msgspec

from marl_sched.errors import InvalidMessageError


class Offer(msgspec.Struct, array_like=True, tag="offer", frozen=True):
    """TeSSI: an agent's best bid, and its own timetable if it were to win.

    Attributes:
        agent: who bids.
        turn: number of the auction.
        task: the task, counted from 0, or -1 if the agent bids on nothing.
        late: whether the bid breaks a deadline or a promise; any other bid beats it.
        urgency: what ranks bids before their costs, lowest first.
        cost: when the agent would end its work.
        timetable: (task, start, finish) of all its tasks, the new one included.
    """

    agent: int
    turn: int
    task: int
    late: bool
    urgency: int
    cost: int
    timetable: list[tuple[int, int, int]]


class Consensus(msgspec.Struct, array_like=True, tag="consensus", frozen=True):
    """CBBA: what an agent believes of every task and how fresh its news of every other agent is.

    Attributes:
        agent: who speaks.
        turn: number of the exchange.
        winners: agent per task, -1 for nobody.
        bids: the winners' bids.
        starts, finishes: the winners' times of the tasks.
        heard: per agent, the exchange from which the speaker last has news of it.
        quiet: for how many exchanges nothing has changed with the speaker and those it heard of.
    """

    agent: int
    turn: int
    winners: list[int]
    bids: list[float]
    starts: list[int]
    finishes: list[int]
    heard: list[int]
    quiet: int


Message = Offer | Consensus
_DECODER = msgspec.msgpack.Decoder(Message)
_ENCODER = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    """The message as it travels."""
    return _ENCODER.encode(message)


def decode(payload: bytes) -> Message:
    """The message in a payload, or InvalidMessageError."""
    try:
        return _DECODER.decode(payload)
    except msgspec.MsgspecError as error:
        raise InvalidMessageError(f"auction: expected an offer or a consensus message: {error}") from error

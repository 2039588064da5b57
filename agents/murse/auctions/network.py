"""Who hears whom, and the exchange of messages until nobody has anything to add.

A `Bidder` only takes payloads in and gives payloads out. `negotiate` carries them within one process; another
transport does the same with its own means: publish what `speak` returns, pass on what comes in to `hear`, and
call `conclude` when all of a turn's messages are there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


class Bidder(ABC):
    """One agent's side of a negotiation, which runs in turns: all speak, all hear, all draw their conclusions."""

    @property
    @abstractmethod
    def finished(self) -> bool:
        """Whether the agent has nothing more to say."""

    @abstractmethod
    def speak(self) -> bytes:
        """What the agent publishes this turn."""

    @abstractmethod
    def hear(self, payload: bytes) -> None:
        """Take in another agent's message; InvalidMessageError if it does not parse."""

    @abstractmethod
    def conclude(self) -> None:
        """End the turn."""


@dataclass(frozen=True)
class Talk:
    """What a negotiation took: turns, messages published and their bytes; a message counts once, whoever hears it."""

    turns: int
    messages: int
    bytes: int


def negotiate(bidders: Sequence[Bidder], hears: np.ndarray, max_turns: int) -> Talk:
    """Exchange messages until every bidder is finished, or for `max_turns`.

    `hears` bool (A, A): [i, j] agent i hears agent j.
    """
    messages = size = 0
    for turn in range(max_turns):
        if all(bidder.finished for bidder in bidders):
            return Talk(turn, messages, size)
        spoken = {j: bidder.speak() for j, bidder in enumerate(bidders) if not bidder.finished}
        messages += len(spoken)
        size += sum(map(len, spoken.values()))
        for i, bidder in enumerate(bidders):
            for j, payload in spoken.items():
                if i != j and hears[i, j]:
                    bidder.hear(payload)
        for j in spoken:
            bidders[j].conclude()
    return Talk(max_turns, messages, size)


def hearing(n_agents: int, map_width: float, radius: float) -> np.ndarray:
    """Who hears whom before a round begins, bool (A, A).

    The agents then stand in a row along the map's lower edge, evenly spaced from one end to the other, and hear
    those within `radius`, in map units.
    """
    places = np.linspace(0.0, map_width, n_agents)
    return np.asarray(np.abs(places[:, None] - places[None]) <= radius)

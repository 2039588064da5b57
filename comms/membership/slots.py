"""One slot per agent: which incarnation the world counts on, in which state, and every way from one to another.

Pure bookkeeping: it neither sends nor waits, and it is told the time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from marl_sched.comms.protocol.messages import Hello


class SlotState(StrEnum):
    """Where a slot stands."""

    VACANT = "vacant"  # nobody has come yet
    READY = "ready"  # an incarnation is registered and has no turn
    ASKED = "asked"  # it has a turn and has not answered
    MISSING = "missing"  # it is not heard any more; it or a successor may come within the grace period
    LOST = "lost"  # given up: its turns pass; another incarnation may register
    BARRED = "barred"  # too many turns in a row were waited for in vain: nobody may register for a while
    LEFT = "left"  # it said goodbye


class SlotEvent(StrEnum):
    """What can happen to a slot."""

    REGISTER = "register"  # another incarnation is accepted
    ASK = "ask"
    DECIDE = "decide"  # an answer in time
    MISS = "miss"  # the deadline passed
    CUT = "cut"  # the liveliness token went, or no heartbeat came
    HEARD = "heard"  # the missing incarnation is there again
    GIVE_UP = "give up"  # the grace period is over, or patience is
    BAR = "bar"
    PARDON = "pardon"
    LEAVE = "leave"


_S, _E = SlotState, SlotEvent
TRANSITIONS: Mapping[tuple[SlotState, SlotEvent], SlotState] = {
    (_S.VACANT, _E.REGISTER): _S.READY,
    (_S.VACANT, _E.GIVE_UP): _S.LOST,
    (_S.READY, _E.ASK): _S.ASKED,
    (_S.READY, _E.CUT): _S.MISSING,
    (_S.READY, _E.LEAVE): _S.LEFT,
    (_S.ASKED, _E.DECIDE): _S.READY,
    (_S.ASKED, _E.MISS): _S.READY,
    (_S.ASKED, _E.CUT): _S.MISSING,
    (_S.ASKED, _E.GIVE_UP): _S.LOST,
    (_S.ASKED, _E.BAR): _S.BARRED,
    (_S.ASKED, _E.LEAVE): _S.LEFT,
    (_S.MISSING, _E.HEARD): _S.READY,
    (_S.MISSING, _E.REGISTER): _S.READY,
    (_S.MISSING, _E.GIVE_UP): _S.LOST,
    (_S.MISSING, _E.BAR): _S.BARRED,
    (_S.MISSING, _E.LEAVE): _S.LEFT,
    (_S.LOST, _E.REGISTER): _S.READY,
    (_S.BARRED, _E.PARDON): _S.LOST,
    (_S.LEFT, _E.REGISTER): _S.READY,
}
PRESENT = frozenset({SlotState.READY, SlotState.ASKED})
Refusal = Literal["given_up", "no_token", "taken", "barred"]
FENCES, TOKENS = 64, 8  # incarnations that a slot remembers at most


@dataclass
class Slot:
    """One agent as the world knows it.

    Attributes:
        state: see SlotState.
        incarnation: the process that the world counts on or waits for, "" while there is none.
        policy: what decides for it, as the agent says.
        missed: turns in a row that were waited for in vain, in however many incarnations.
        waited: seconds that the run waited for them, since its last decision in time.
        waited_in_all: seconds that the run waited in vain in all.
        turns: turns given so far, the sequence of the last one.
        heard_at: when its incarnation was last heard.
        until: when a missing slot is given up, or a barred one pardoned.
        losses: how often it was given up.
        fenced: incarnations that the world will not count on again, the newest FENCES of them.
        tokens: incarnations whose liveliness token stands, the newest TOKENS of them.
        counts: what its incarnation counted, as it last said.
        early: the last hello that came before its incarnation's token.
        remembered: decisions that its incarnation's memory held at the last one, None without a memory or before any.
        memory_began: simulated time at which that memory was first decided with, None without a memory.
        moves: shared by all slots of a membership, see there.
    """

    state: SlotState = SlotState.VACANT
    incarnation: str = ""
    policy: str = ""
    missed: int = 0
    waited: float = 0.0
    waited_in_all: float = 0.0
    turns: int = 0
    heard_at: float = 0.0
    until: float = math.inf
    losses: int = 0
    fenced: deque[str] = field(default_factory=lambda: deque(maxlen=FENCES))
    tokens: deque[str] = field(default_factory=lambda: deque(maxlen=TOKENS))
    counts: dict[str, int] = field(default_factory=dict)
    early: Hello | None = None
    remembered: int | None = None
    memory_began: int | None = None
    moves: Moves = field(default_factory=lambda: Moves())

    def move(self, event: SlotEvent) -> None:
        """Go where TRANSITIONS says; KeyError, which is a defect, where it says nothing."""
        before, self.state = self.state, TRANSITIONS[self.state, event]
        self.moves.all += event != SlotEvent.ASK
        self.moves.lasting += before not in PRESENT or self.state not in PRESENT

    def remember(self, remembered: int | None, time: int) -> bool:
        """Note what an incarnation says of its memory at a decision; True if it is its first with a memory."""
        began = remembered is not None and self.remembered is None
        self.remembered = remembered
        if began:
            self.memory_began = time
        return began

    @property
    def present(self) -> bool:
        """Whether an incarnation can be asked or is being asked."""
        return self.state in PRESENT


def max_misses(patience: int) -> int:
    """Turns in a row for which one agent can make the others wait in vain before it is barred."""
    return 2 * patience


@dataclass
class Moves:
    """Counts moves, so that what follows from the states of all slots is worked out only when one has changed.

    Attributes:
        all: but those by which a ready agent is asked.
        lasting: but those between the states in which an agent is present.
    """

    all: int = 0
    lasting: int = 0


class Membership:
    """The slots of all agents.

    Attributes:
        moves: how often slots have changed their state.

    After `patience` misses in a row an incarnation is given up. Its successors inherit the misses: each is given up
    at its first miss, and after `max_misses(patience)` in a row the slot is barred for `bar` seconds, then one more
    incarnation may try. A decision in time clears the slot's misses.
    """

    def __init__(self, n_agents: int, patience: int, bar: float) -> None:
        self.moves = Moves()
        self.slots = [Slot(moves=self.moves) for _ in range(n_agents)]
        self._patience, self._bar = patience, bar
        self._counted_at, self._staying, self._present = -1, 0, 0
        self._looked_at, self._due = -1, math.inf

    def absent(self) -> list[int]:
        """Agents that nobody speaks for, but for those that left."""
        return [i for i, slot in enumerate(self.slots) if not slot.present and slot.state != SlotState.LEFT]

    def due(self, unheard: float) -> float:
        """When a slot may have to be looked at, at the earliest; hearing an agent only makes it later.

        With a hundred agents, looking at all slots at every event would be most of what an event costs.
        """
        if self._looked_at != self.moves.all:
            self._looked_at = self.moves.all
            ready = (slot.heard_at + unheard for slot in self.slots if slot.state == SlotState.READY)
            self._due = min([*(slot.until for slot in self.slots), *ready])
        return self._due

    def look_again(self) -> None:
        """Work out anew when a slot is due, though none has moved."""
        self._looked_at = -1

    def quorate(self, quorum: float) -> bool:
        """Whether at least the share `quorum` of the agents that have not left is present, one at least."""
        if self._counted_at != self.moves.lasting:
            self._counted_at = self.moves.lasting
            self._staying = sum(slot.state != SlotState.LEFT for slot in self.slots)
            self._present = sum(slot.present for slot in self.slots)
        return self._present >= max(math.ceil(quorum * self._staying), min(self._staying, 1))

    def refusal(self, agent: int, incarnation: str) -> Refusal | None:
        """Why an incarnation cannot be registered, None if it can."""
        slot = self.slots[agent]
        if incarnation in slot.fenced:
            return "given_up"
        if incarnation not in slot.tokens:
            return "no_token"
        if slot.present:
            return "taken"
        if slot.state == SlotState.BARRED or slot.missed >= max_misses(self._patience):
            return "barred"
        return None

    def register(self, agent: int, incarnation: str, policy: str, now: float) -> None:
        """Count on an incarnation that `refusal` has nothing against; the one before is fenced."""
        slot = self.slots[agent]
        if slot.incarnation:
            slot.fenced.append(slot.incarnation)
        slot.move(SlotEvent.REGISTER)
        slot.incarnation, slot.policy, slot.heard_at, slot.until = incarnation, policy, now, math.inf
        slot.remembered = None

    def cut(self, agent: int, until: float) -> None:
        """Stop hearing an incarnation; it may come back until then."""
        slot = self.slots[agent]
        slot.move(SlotEvent.CUT)
        slot.until = until

    def hear(self, agent: int, now: float) -> bool:
        """Note that the slot's incarnation was heard; True if it had been missing."""
        slot = self.slots[agent]
        slot.heard_at = now
        if slot.state != SlotState.MISSING:
            return False
        slot.move(SlotEvent.HEARD)
        slot.until = math.inf
        return True

    def give_up(self, agent: int, now: float) -> None:
        """Stop counting on an incarnation, for good; the slot is barred if too much was waited for it."""
        slot = self.slots[agent]
        barred = slot.missed >= max_misses(self._patience) and slot.state != SlotState.VACANT
        slot.move(SlotEvent.BAR if barred else SlotEvent.GIVE_UP)
        if slot.incarnation:
            slot.fenced.append(slot.incarnation)
        slot.incarnation, slot.losses = "", slot.losses + 1
        slot.until = now + self._bar if barred else math.inf

    def pardon(self, agent: int) -> None:
        """Let one more incarnation try for a barred slot."""
        slot = self.slots[agent]
        slot.move(SlotEvent.PARDON)
        slot.missed, slot.until = max_misses(self._patience) - 1, math.inf

    def leave(self, agent: int) -> None:
        """An incarnation says goodbye."""
        slot = self.slots[agent]
        slot.move(SlotEvent.LEAVE)
        slot.fenced.append(slot.incarnation)
        slot.incarnation, slot.until = "", math.inf

    def miss(self, agent: int, waited: float) -> bool:
        """Note a turn that was waited for in vain for `waited` seconds; True if it was one too many."""
        slot = self.slots[agent]
        slot.missed += 1
        slot.waited += waited
        slot.waited_in_all += waited
        return slot.missed >= self._patience

    def answered(self, agent: int) -> None:
        """Note a decision in time."""
        slot = self.slots[agent]
        slot.move(SlotEvent.DECIDE)
        slot.missed, slot.waited = 0, 0.0

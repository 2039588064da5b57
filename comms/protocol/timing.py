"""When things are due in a run of the world; times are seconds of whatever clock the driver has."""

from __future__ import annotations

import math
from dataclasses import dataclass

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.rules import WorldRules


@dataclass
class OpenTurn:
    """A decision that the plant asks for. `turn` is None while nobody can be asked."""

    request: ev.Request
    turn: wire.Turn | None = None
    asked_at: float = 0.0
    deadline: float = math.inf
    resend_at: float = math.inf
    give_up_at: float = math.inf  # however often its agent goes missing and returns

    def open(self, now: float, rules: WorldRules, tick_end: float) -> None:
        """Let the time begin in which it is to be answered; it is put at once."""
        self.give_up_at = min(self.give_up_at, now + rules.deadline + rules.grace)
        self.deadline = min(now + rules.deadline, tick_end, self.give_up_at)
        self.asked_at, self.resend_at = now, now

    def move(self, by: float, now: float) -> None:
        """Give its agent the time in which nobody could answer, and put it again."""
        self.deadline, self.give_up_at, self.asked_at = self.deadline + by, self.give_up_at + by, self.asked_at + by
        self.resend_at = min(self.resend_at, now)


@dataclass
class RunTimes:
    """What the run as a whole waits for.

    Attributes:
        ready_by: agents are waited for at the start.
        clock_at: the clock is told again.
        standing_since: time stands still, inf while it does not.
        farewell_by: agents are waited for at the end, inf before it.
        poll_at: the plant is asked again whether there is something to decide.
        forgiving_until: agents that were lost while the world slept may come back.
        paced_from, first_tick: when the paced clock began, and at which simulated time.
        held_until, tick_end: when the paced clock lets this tick begin and end.
    """

    rules: WorldRules
    ready_by: float
    clock_at: float
    standing_since: float = math.inf
    farewell_by: float = math.inf
    poll_at: float = -math.inf
    forgiving_until: float = -math.inf
    paced_from: float = 0.0
    first_tick: int = 0
    held_until: float = -math.inf
    tick_end: float = math.inf

    def begin_tick(self, tick: int) -> None:
        """A tick of the paced clock begins at its time, and ends when the next one begins."""
        if self.rules.clock == "paced":
            self.held_until = self.paced_from + (tick - self.first_tick) * self.rules.pace
            self.tick_end = self.held_until + self.rules.pace

    def move(self, by: float) -> None:
        """Leave out a time in which nothing could happen."""
        self.ready_by += by
        self.standing_since += by
        self.paced_from += by
        self.held_until += by
        self.tick_end += by

    def due(self, now: float, *, gathering: bool, paused: bool) -> list[float]:
        """When something of this has to be looked at, at least one time."""
        times = [self.clock_at, self.farewell_by]
        if gathering:
            times.append(self.ready_by)
        times += [at for at in (self.held_until, self.poll_at, self.forgiving_until) if at > now]
        if self.standing_since < math.inf and not paused:
            times.append(self.standing_since + self.rules.standstill)
        return times

"""A query that is put again until it is answered. No clock, thread or socket."""

from __future__ import annotations

import math

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.rules import AgentRules


class Question:
    """The one question that an agent has; a new one takes the place of the old.

    Attributes:
        number: of the last time that a question was put; only the answer to that one counts.
        key: what is asked, None if nothing is.
        wake_at: when `due` has something to put at the earliest.
    """

    def __init__(self, rules: AgentRules) -> None:
        self._rules, self.number = rules, 0
        self.key: str | None = None
        self._message: wire.Message | None = None
        self._ask_at = self._answer_by = math.inf

    @property
    def wake_at(self) -> float:
        """See the attributes."""
        return min(self._ask_at, self._answer_by)

    def ask(self, key: str, message: wire.Message | None, now: float) -> ev.Ask:
        """Put a question."""
        self.key, self._message = key, message
        self.number += 1
        self._ask_at, self._answer_by = math.inf, now + self._rules.answer
        return ev.Ask(self.number, key, message)

    def due(self, now: float) -> ev.Ask | None:
        """The question again, where no answer came in time or the time after a bad one is over."""
        if now >= self._answer_by:
            self._ask_at, self._answer_by = now, math.inf
        if self.key is None or now < self._ask_at:
            return None
        return self.ask(self.key, self._message, now)

    def retry(self, now: float) -> None:
        """The answer was none: put it again after a while."""
        self._ask_at, self._answer_by = now + self._rules.retry, math.inf

    def close(self) -> None:
        """It is answered, or nobody waits for the answer any more."""
        self.key, self._message = None, None
        self._ask_at = self._answer_by = math.inf

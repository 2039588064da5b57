"""Who is there: which incarnation of every agent the world counts on, and why it stopped doing so."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Seat:
    """One agent as the world knows it.

    Attributes:
        incarnation: the process that the world counts on, "" while there is none.
        policy: what decides for it, as the agent says.
        missed: turns in a row that the others waited for in vain, in however many incarnations.
        waited: seconds that they waited, since its last decision in time.
        waited_in_all: seconds that they waited in vain in the whole run.
        turns: turns given so far, the sequence of the last one.
        fenced: incarnations that the world will not count on again.
    """

    incarnation: str = ""
    policy: str = ""
    missed: int = 0
    waited: float = 0.0
    waited_in_all: float = 0.0
    turns: int = 0
    fenced: set[str] = field(default_factory=set)


def most_misses(patience: int) -> int:
    """Turns in a row for which one agent can make the others wait in vain: at most `patience` successors try again."""
    return 2 * patience


class Roster:
    """The seats of all agents. Pure bookkeeping: it neither sends nor waits.

    After `patience` misses in a row an incarnation is given up. Its successors inherit the misses: each is given up
    at its first miss, and after `most_misses(patience)` in a row nobody is admitted any more. A decision in time
    clears the seat's misses.
    """

    def __init__(self, n_agents: int, patience: int) -> None:
        self.seats = [Seat() for _ in range(n_agents)]
        self._patience = patience

    def missing(self) -> list[int]:
        """Agents that nobody speaks for."""
        return [agent for agent, seat in enumerate(self.seats) if not seat.incarnation]

    def admit(self, agent: int, incarnation: str, policy: str) -> str:
        """Seat an incarnation; "" or why it is refused. Saying hello twice changes nothing."""
        if not 0 <= agent < len(self.seats):
            return f"there is no agent {agent}, the run has agents 0 to {len(self.seats) - 1}"
        seat = self.seats[agent]
        if incarnation == seat.incarnation:
            return ""
        if incarnation in seat.fenced:
            return "this incarnation has been declared dead"
        if seat.incarnation:
            return "another process decides for this agent"
        if seat.missed >= most_misses(self._patience):
            return f"its {seat.missed} turns in a row were waited for in vain, it is not asked again"
        seat.incarnation, seat.policy = incarnation, policy
        return ""

    def bury(self, agent: int, incarnation: str) -> bool:
        """Stop counting on an incarnation, for good; False if it was not the one that the world counted on."""
        seat = self.seats[agent]
        if not incarnation or seat.incarnation != incarnation:
            return False
        seat.fenced.add(incarnation)
        seat.incarnation = ""
        return True

    def miss(self, agent: int, waited: float) -> bool:
        """Note a turn that was waited for in vain for `waited` seconds; True if it was one too many."""
        seat = self.seats[agent]
        seat.missed += 1
        seat.waited += waited
        seat.waited_in_all += waited
        return seat.missed >= self._patience

    def answered(self, agent: int) -> None:
        """Note a decision in time."""
        self.seats[agent].missed, self.seats[agent].waited = 0, 0.0

"""TeSSI: temporal sequential single-item auctions (Nunes and Gini, 2015).

In every turn each agent bids on the open task that lets it end its work earliest, its own temporal network
permitting, and the lowest bid of all wins. Tasks come up once all that they wait for are taken. The paper's agents
report to an auctioneer; here there is none: everybody names the winner from the bids heard, so that agents
that do not hear each other may both believe to have won a task. And the paper leaves out a task that fits
nobody's network; here its deadline is given up and the task goes behind all others of the earliest bidder.

In the paper only the end of work counts. Bidders may be given an urgency of every task, which everybody knows; bids
on more urgent tasks then come first, and the end of work decides who gets the task.
"""

from __future__ import annotations

import numpy as np

from marl_sched.agents.murse.auctions.agent_schedule import AgentSchedule
from marl_sched.agents.murse.auctions.messages import Offer, decode, encode
from marl_sched.agents.murse.auctions.network import Bidder
from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.errors import InvalidMessageError

_NOTHING = -1


class TessiBidder(Bidder):
    """One agent's side of the auctions; `schedule` holds their outcome.

    `urgency` int64 (N,) ranks bids before their costs, lowest first; zeros as in the paper.
    """

    def __init__(self, schedule: AgentSchedule, urgency: np.ndarray) -> None:
        self.schedule, self._urgency = schedule, urgency
        self._turn = 0
        self._offers: list[Offer] = []
        self._over = False

    @property
    def finished(self) -> bool:
        """Whether nobody in hearing bids any more."""
        return self._over

    def speak(self) -> bytes:
        """The agent's best bid."""
        offer = self._best_offer()
        self._offers = [offer]
        return encode(offer)

    def hear(self, payload: bytes) -> None:
        """Another agent's bid."""
        message = decode(payload)
        if not isinstance(message, Offer):
            raise InvalidMessageError(f"tessi: expected an offer, got {type(message).__name__}")
        self._offers.append(message)

    def conclude(self) -> None:
        """Name the winner among the bids heard and take down its new timetable."""
        self._turn += 1
        bids = [offer for offer in self._offers if offer.task != _NOTHING]
        if not bids:
            self._over = True
            return
        winner = min(bids, key=lambda bid: (bid.late, bid.urgency, bid.cost, bid.task, bid.agent))
        if winner.late:
            self.schedule.deadlines[winner.task] = NO_DEADLINE
        self.schedule.note(winner.agent, winner.timetable)

    def _best_offer(self) -> Offer:
        schedule = self.schedule
        best: tuple[bool, int, int, int, int] | None = None
        for task in range(len(schedule.holder)):
            if schedule.holder[task] != _NOTHING or not schedule.ready(task):
                continue
            place, cost, end = schedule.place(task)
            urgency = int(self._urgency[task])
            bid = (False, urgency, cost, end, task) if place >= 0 else (True, urgency, schedule.end_of(task), 0, task)
            best = bid if best is None else min(best, bid)
        if best is None:
            return Offer(schedule.agent, self._turn, _NOTHING, False, 0, 0, [])
        late, urgency, cost, _, task = best
        return Offer(schedule.agent, self._turn, task, late, urgency, cost, self._timetable(task, late, cost))

    def _timetable(self, task: int, late: bool, cost: int) -> list[tuple[int, int, int]]:
        schedule = self.schedule
        if late:
            kept = [(own, int(schedule.starts[own]), int(schedule.finishes[own])) for own in schedule.path]
            return [*kept, (task, cost - int(schedule.durations[task, schedule.agent]), cost)]
        place = schedule.place(task)[0]
        return schedule.times([*schedule.path[:place], task, *schedule.path[place:]])

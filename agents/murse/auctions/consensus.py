"""CBBA's table of what to do with another agent's belief about a task (Choi, Brunet and How, 2009, table 1)."""

from __future__ import annotations

import numpy as np

LEAVE, UPDATE, RESET = 0, 1, 2
_NOBODY = -1


def resolve(
    me: int,
    sender: int,
    mine: int,
    theirs: int,
    my_bid: float,
    their_bid: float,
    my_news: np.ndarray,
    their_news: np.ndarray,
) -> int:
    """LEAVE my belief about a task, UPDATE it to the sender's, or RESET it to nobody.

    `mine` and `theirs` are the agents that each of us holds for the winner, -1 for nobody; `my_news` and
    `their_news`, int64 (A,), the exchange from which each has the last news of every agent. Equal bids go to
    the lower agent.
    """

    def higher() -> bool:
        return (their_bid, -theirs) > (my_bid, -mine)

    def fresher(agent: int) -> bool:
        return bool(their_news[agent] > my_news[agent])

    if theirs == sender:
        if mine == me:
            return UPDATE if higher() else LEAVE
        if mine in (sender, _NOBODY):
            return UPDATE
        return UPDATE if fresher(mine) or higher() else LEAVE
    if theirs == me:
        if mine in (me, _NOBODY):
            return LEAVE
        return RESET if mine == sender or fresher(mine) else LEAVE
    if theirs == _NOBODY:
        if mine in (me, _NOBODY):
            return LEAVE
        return UPDATE if mine == sender or fresher(mine) else LEAVE
    return _third(me, sender, mine, theirs, higher(), fresher(theirs), mine >= 0 and fresher(mine))


def _third(me: int, sender: int, mine: int, theirs: int, higher: bool, fresher: bool, fresher_of_mine: bool) -> int:
    """The table's part in which the sender holds a third agent for the winner."""
    if mine == me:
        return UPDATE if fresher and higher else LEAVE
    if mine == sender:
        return UPDATE if fresher else RESET
    if mine in (theirs, _NOBODY):
        return UPDATE if fresher else LEAVE
    if fresher and (fresher_of_mine or higher):
        return UPDATE
    return RESET if fresher_of_mine and not fresher else LEAVE

"""The protocol's numbers. Times in seconds; comms/PROTOCOL.md says why the defaults are what they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ClockKind = Literal["lockstep", "paced", "free"]


@dataclass(frozen=True, kw_only=True)
class WorldRules:
    """The run's numbers; times in seconds.

    Attributes:
        clock: who owns time. `lockstep`: it waits for missing agents and below the quorum; `paced`: `pace` seconds
            for each unit of simulated time; `free`: it waits for nobody but those that have a turn.
        pace: seconds per unit of simulated time, of the paced clock.
        deadline: a decision may take that long; a late one idles the agent for this decision epoch.
        patience: missed deadlines in a row after which an incarnation is given up.
        grace: how long a missing agent is waited for before it counts as lost; 0 with the free clock.
        quorum: share of the agents below which the lockstep clock stands still.
        standstill: how long it may stand still before the run ends.
        ready: how long to wait for all agents at the start.
        heartbeat: the clock is told at least that often, and agents say that they live.
        unheard: an agent without a turn that says nothing for that long is missing.
        slept: the world takes a wake-up that is late by more than that for its own sleep.
        resend: until an open turn is sent again.
        poll: until a plant in which nobody has anything to decide is asked again.
        farewell: in which agents may leave at the end.
        bar: how long nobody may register for an agent that was waited for in vain too often.
    """

    clock: ClockKind = "lockstep"
    pace: float = 1.0
    deadline: float = 2.0
    patience: int = 3
    grace: float = 5.0
    quorum: float = 0.5
    standstill: float = 60.0
    ready: float = 60.0
    heartbeat: float = 0.5
    unheard: float = 3.0
    slept: float = 1.0
    resend: float = 0.1
    poll: float = 0.05
    farewell: float = 2.0
    bar: float = 60.0


@dataclass(frozen=True, kw_only=True)
class AgentRules:
    """An agent's numbers, in seconds.

    Attributes:
        join: how long to look for the world and wait to be let in, at the start and when the world is lost.
        retry: between two hellos, and before a question that was not answered is put again.
        answer: how long an answer may take.
        taken: how long the agent's place may be taken by another process: that one may just be dying.
        silence: a world that is not heard for that long is reached for by a new session.
        slept: a wake-up that is late by more than that is this process's own sleep.
    """

    join: float = 60.0
    retry: float = 0.2
    answer: float = 1.0
    taken: float = 5.0
    silence: float = 4.0
    slept: float = 1.0

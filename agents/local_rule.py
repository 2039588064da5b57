"""Schedulers that are no policy of an observation, and yet decide on what one agent is told (LocalState)."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

from marl_sched.agents.base import Scheduler

if TYPE_CHECKING:
    from marl_sched.domain_parts import LocalState


class LocalRule(Scheduler):
    """Decides in a simulator for agents that see what their view shows, and as a process on the local state of one."""

    @abstractmethod
    def choose_locally(self, known: LocalState) -> int:
        """One agent's action on what it was told, equal to its choice in the simulator."""

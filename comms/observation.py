"""What observers of a running world are told: who is there, what was decided, what goes wrong."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence

from marl_sched.comms.membership.slots import Slot
from marl_sched.comms.plant import Commit
from marl_sched.comms.protocol import messages as wire

MAX_TOLD = 400  # decisions that one message tells of


class Observation:
    """Gathers what the next message to observers tells; between two of them it keeps MAX_TOLD decisions at most.

    Attributes:
        last_error: the last warning of the world, "" before the first.
    """

    def __init__(self, prefix: str, unit: str, horizon: int) -> None:
        self.last_error = ""
        self._prefix, self._unit, self._horizon = prefix, unit, horizon
        self._decided = 0
        self._new: deque[wire.Decided] = deque(maxlen=MAX_TOLD)

    def note(self, commits: Sequence[Commit]) -> None:
        """Take in what was applied."""
        self._decided += len(commits)
        self._new += [wire.Decided(c.tick, c.agent, c.action, str(c.outcome)) for c in commits]

    def message(
        self,
        run: str,
        epoch: str,
        *,
        tick: int,
        phase: wire.Phase,
        slots: Sequence[Slot],
        objectives: dict[str, float],
        counts: Counter[str],
        now: float,
    ) -> wire.Observed:
        """The message that is due; the decisions in it are told once."""
        decided = list(self._new)
        self._new.clear()
        agents = [
            wire.Seen(
                name=f"{self._prefix}_{i}",
                state=str(slot.state),
                policy=slot.policy[:200],
                turns=slot.turns,
                losses=slot.losses,
                silent=max(now - slot.heard_at, 0.0),
            )
            for i, slot in enumerate(slots)
        ]
        return wire.Observed(
            run=run,
            epoch=epoch,
            tick=tick,
            horizon=self._horizon,
            phase=phase,
            unit=self._unit,
            agents=agents,
            decisions=self._decided,
            decided=decided,
            objectives=objectives,
            counts={kind: count for kind, count in sorted(counts.items())[:32] if count},
            last_error=self.last_error[:400],
        )

"""Pictures: the day as text, and what every courier did as an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from couriers.simulator import CouriersSimulator

BUSY, IDLE = (86, 160, 211), (214, 219, 223)
BAND = 8  # pixels a courier is high
_DAY = 10  # pixels a day is wide


def board(simulator: CouriersSimulator, row: int = 0) -> str:
    """The jobs of today, by their slot."""
    waiting = np.flatnonzero(simulator.jobs["there"][row] & ~simulator.jobs["taken"][row])
    return f"day {simulator.time[row]}   waiting: {', '.join(map(str, waiting)) or 'none'}"


def timeline(simulator: CouriersSimulator, row: int = 0) -> np.ndarray:
    """What every courier did on every day so far, uint8 (height, width, 3)."""
    days = max(int(simulator.time[row]), 1)
    image = np.full((int(simulator.n_agents[row]), days, 3), IDLE, np.uint8)
    for courier, day, length in simulator.history[row]:
        image[courier, day : day + length] = BUSY
    return image.repeat(BAND, axis=0).repeat(_DAY, axis=1)

"""Pictures: the day as text, and what every courier did as an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from couriers.simulator import CouriersSimulator

BUSY, IDLE = (86, 160, 211), (214, 219, 223)
BAND = 8  # pixels a courier is high
_DAY = 10  # pixels a day is wide


def board(simulator: CouriersSimulator, env_index: int = 0) -> str:
    """The jobs of today, by their slot."""
    waiting = np.flatnonzero(simulator.jobs["there"][env_index] & ~simulator.jobs["taken"][env_index])
    return f"day {simulator.time[env_index]}   waiting: {', '.join(map(str, waiting)) or 'none'}"


def timeline(simulator: CouriersSimulator, env_index: int = 0) -> np.ndarray:
    """What every courier did on every day so far, uint8 (height, width, 3)."""
    days = max(int(simulator.time[env_index]), 1)
    image = np.full((int(simulator.n_agents[env_index]), days, 3), IDLE, np.uint8)
    for courier, day, length in simulator.history[env_index]:
        image[courier, day : day + length] = BUSY
    return image.repeat(BAND, axis=0).repeat(_DAY, axis=1)

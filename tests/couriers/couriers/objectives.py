"""An objective that the domain does not have: waiting jobs and places travelled at once, as a vector."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from couriers.simulator import CouriersSimulator


class Strain:
    """Minus waiting jobs, and minus half the places travelled; see marl_sched.objective.Objective."""

    parts = ("waiting", "travel")

    def start(self, simulator: CouriersSimulator, envs: np.ndarray) -> None:
        """Nothing is kept."""

    def total(self, simulator: CouriersSimulator) -> np.ndarray:
        """Both sums so far, float64 (B, 2)."""
        return -simulator.sums * np.array([1.0, 0.5])

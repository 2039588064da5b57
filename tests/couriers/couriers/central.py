"""The centralised interface: a job, or 0, for each courier; one step is a day."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

if TYPE_CHECKING:
    from couriers.simulator import CouriersSimulator


class DailyDecisions:
    """A joint action is a job's slot for each courier, int64 (C,); those of couriers without a turn are ignored."""

    def action_space(self, simulator: CouriersSimulator) -> spaces.MultiDiscrete:
        """`MultiDiscrete([N + 1] * C)`."""
        return spaces.MultiDiscrete(np.full(simulator.max_agents, simulator.max_actions))

    def play(self, simulator: CouriersSimulator, action: Any) -> tuple[float, dict[str, Any]]:
        """Take the turns of this day; the reward, and which couriers chose what cannot be."""
        reward, illegal = 0.0, []
        while simulator.acting[0] >= 0:
            agent = int(simulator.acting[0])
            legal = simulator.legal()[0, action[agent]]
            if not legal:
                illegal.append(agent)
            simulator.step(np.array([action[agent] if legal else 0]))
            reward += float(simulator.reward[0])
            if simulator.elapsed[0]:
                break
        return reward, {"illegal": illegal}


CENTRAL = DailyDecisions()

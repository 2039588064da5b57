"""The ward's centralised interface: a patient, or 0, for each nurse; one step is the time to the next decisions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from marl_sched.envs.ward.dynamics import is_possible

if TYPE_CHECKING:
    from marl_sched.envs.ward.simulator import WardSimulator


class QuarterHourlyDecisions:
    """A joint action is a patient's slot for each nurse, int64 (N,); those of nurses without a turn are ignored."""

    def action_space(self, simulator: WardSimulator) -> spaces.MultiDiscrete:
        """`MultiDiscrete([P + 1] * N)`, padded like the simulator."""
        return spaces.MultiDiscrete(np.full(simulator.max_agents, simulator.max_actions))

    def action_masks(self, simulator: WardSimulator) -> np.ndarray:
        """For each nurse 0 and the patients whom she may take over; 0 alone without a turn. Bool (N (P + 1),)."""
        masks = np.zeros((simulator.max_agents, simulator.max_actions), bool)
        masks[:, 0] = True
        for nurse in simulator.free_agents(0):
            for slot in range(1, simulator.max_actions):
                masks[nurse, slot] = is_possible(simulator.state, 0, int(nurse), slot)
        return masks.ravel()

    def play(self, simulator: WardSimulator, action: Any) -> tuple[float, dict[str, Any]]:
        """Take the turns of this quarter of an hour; the reward, and which nurses chose what cannot be."""
        reward, illegal = 0.0, []
        while simulator.acting[0] >= 0:
            nurse = int(simulator.acting[0])
            simulator.step(np.array([action[nurse]]))
            reward += float(simulator.reward[0])
            if simulator.conflict[0]:
                illegal.append(nurse)
            if simulator.elapsed[0]:
                break
        return reward, {"illegal": illegal}


CENTRAL = QuarterHourlyDecisions()

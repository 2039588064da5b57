"""AirME's centralised interface: every hour one decision for each crew (dissertation, section 6.2.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from marl_sched.envs.airme.state import IDLE

if TYPE_CHECKING:
    from marl_sched.envs.airme.simulator import AirmeSimulator


class HourlyDecisions:
    """A joint action is an action for each crew, int64 (C,); one step is one hour.

    Actions of busy crews are ignored. A plane that is in somebody's hands, chosen by a lower crew this hour or
    not of this fleet idles its crew, whose index the step's infos list under `illegal`. Free crews decide in
    ascending order; under the scheme `skip` the first action 0 ends the hour's decisions, under `single` the
    first decision does, and the actions of the remaining crews are ignored (section 6.3.1).
    """

    def action_space(self, simulator: AirmeSimulator) -> spaces.MultiDiscrete:
        """`MultiDiscrete([P + 1] * C)`, padded like the simulator."""
        return spaces.MultiDiscrete(np.full(simulator.max_agents, simulator.max_actions))

    def action_masks(self, simulator: AirmeSimulator) -> np.ndarray:
        """For each crew the planes that nobody repairs, and 0; 0 alone for a crew that is busy. Bool (C (P + 1),)."""
        masks = np.zeros((simulator.max_agents, simulator.max_actions), bool)
        slots = np.arange(simulator.max_actions)
        unattended = (slots <= simulator.state.rows["n_planes"][0]) & (simulator.state.planes["crew"][0] < 0)
        masks[simulator.free_agents(0)] = unattended
        masks[:, IDLE] = True
        return masks.ravel()

    def play(self, simulator: AirmeSimulator, action: Any) -> tuple[float, dict[str, Any]]:
        """Play one hour of row 0; the reward of the hour, and which crews idled for an impossible action."""
        choices = np.full(simulator.max_agents, IDLE, np.int64)
        planes = simulator.state.planes[0]
        illegal = []
        taken: set[int] = set()
        for crew in simulator.free_agents(0):
            plane = choices[crew] = int(action[crew])
            if plane != IDLE:
                if plane > simulator.state.rows["n_planes"][0] or planes["crew"][plane] >= 0 or plane in taken:
                    illegal.append(int(crew))
                taken.add(plane)
            if simulator.scheme == "single" or (simulator.scheme == "skip" and plane == IDLE):
                break
        simulator.play_hour(choices[None])
        return float(simulator.reward[0]), {"illegal": illegal}


CENTRAL = HourlyDecisions()

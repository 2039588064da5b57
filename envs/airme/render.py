"""Pictures of a running AirME episode: a fleet board as text, and the timeline of every plane as an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marl_sched.envs.airme.state import BROKEN, FLYING, GROUNDED, REPAIR
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.envs.airme.simulator import AirmeSimulator

COLOURS = {
    GROUNDED: (214, 219, 223),
    FLYING: (86, 160, 211),
    BROKEN: (203, 67, 53),
    REPAIR: (244, 176, 64),
}
LEGEND = {
    "flying": COLOURS[FLYING],
    "grounded": COLOURS[GROUNDED],
    "in repair": COLOURS[REPAIR],
    "broken and waiting": COLOURS[BROKEN],
}
_BOARD_COLUMNS = 3


def fleet_board(simulator: AirmeSimulator, env_index: int = 0) -> str:
    """The fleet and the crews of one row at this hour, as text."""
    state, n_planes, n_crews = (
        simulator.state,
        simulator.state.rows["n_planes"][env_index],
        simulator.n_agents[env_index],
    )
    means = simulator.objectives()
    planes = list(enumerate(state.planes[env_index, 1 : n_planes + 1], start=1))
    head = f"hour {simulator.time[env_index]:>4}   " + "   ".join(f"{k} {v[env_index]:.3f}" for k, v in means.items())
    names = [kind.name for kind in simulator.types]
    width = max(map(len, names))
    cells = [_plane_cell(plane, slot, names[plane["kind"]].ljust(width)) for slot, plane in planes]
    height = -(-len(cells) // _BOARD_COLUMNS)
    lines = ["   ".join(cells[i::height]) for i in range(height)]
    crews = [_crew_cell(state.crews[env_index, crew], crew) for crew in range(n_crews)]
    return "\n".join([head, *lines, "   ".join(crews)])


def _plane_cell(plane: np.void, slot: int, kind: str) -> str:
    if plane["crew"] >= 0:
        what = f"repair {plane['job_done']:>2}/{plane['job_hours']:<2} by crew {plane['crew']}"
    elif plane["broken"]:
        what = "BROKEN"
    elif plane["mission_hours"] > 0:
        what = f"flying {plane['mission_done']:>2}/{plane['mission_hours']:<2}"
    else:
        what = "grounded"
    return f"{slot:>3} {kind} {plane['hours']:>3} h {plane['landings']:>2} ldg  {what:<23}"


def _crew_cell(crew: np.void, index: int) -> str:
    return f"crew {index}: " + (f"plane {crew['plane']}" if crew["plane"] else "free")


def require_timeline(simulator: AirmeSimulator) -> None:
    """InvalidOptionError if a simulator did not record what its planes did."""
    if not len(simulator.state.timeline):
        raise InvalidOptionError("render: the simulator was made without record_timeline=True")


def timeline(simulator: AirmeSimulator, env_index: int = 0) -> np.ndarray:
    """What every plane and crew did so far, with labels, uint8 (540, 960, 3): every picture of an episode alike.

    Needs matplotlib, see marl_sched.envs.airme.timeline_figure. Raises InvalidOptionError if the simulator was made
    without `record_timeline`.
    """
    require_timeline(simulator)
    from marl_sched.envs.airme.timeline_figure import frame

    return frame(simulator, env_index)

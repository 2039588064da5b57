"""Pictures of a running ward: a board as text, and who lay in which bed as an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marl_sched.envs.ward.instance import QUARTERS, STAGES
from marl_sched.errors import InvalidOptionError

if TYPE_CHECKING:
    from marl_sched.envs.ward.simulator import WardSimulator

FREE = (214, 219, 223)
WITH_CARE = ((186, 214, 235), (107, 174, 214), (33, 113, 181), (199, 233, 192))  # by stage
WITHOUT_CARE = (203, 67, 53)
LEGEND = {"free bed": FREE, **dict(zip(STAGES, WITH_CARE, strict=True)), "without care": WITHOUT_CARE}
CELL = 8  # pixels a bed is high
_QUARTER = 4  # pixels a quarter of an hour is wide


def board(simulator: WardSimulator, env_index: int = 0) -> str:
    """The ward at this quarter of an hour: who waits, who lies where with which nurse, what nurses do."""
    state, row = simulator.state, simulator.state.rows[env_index]
    hours, quarters = divmod(int(row["time"]), QUARTERS)
    means = "   ".join(f"{name} {values[env_index]:.2f}" for name, values in simulator.objectives().items())
    lines = [f"{hours:>3}:{15 * quarters:02}   {means}"]
    for section in range(int(state.beds["section"][env_index, : row["n_beds"]].max()) + 1):
        waiting = [
            _patient(patient, slot)
            for slot, patient in enumerate(state.patients[env_index])
            if patient["there"] and patient["bed"] < 0 and patient["section"] == section
        ]
        beds = [
            _bed(state.patients[env_index, bed["patient"]], int(bed["patient"]))
            for bed in state.beds[env_index, : row["n_beds"]]
            if bed["section"] == section
        ]
        lines.append(f"section {section}   beds: {' | '.join(beds)}   waiting: {', '.join(waiting) or 'nobody'}")
    return "\n".join([*lines, "   ".join(_nurse(simulator, env_index, n) for n in range(row["n_nurses"]))])


def _patient(patient: np.void, slot: int) -> str:
    return f"{slot} {STAGES[patient['stage']]}{'!' if patient['high_risk'] else ''}"


def _bed(patient: np.void, slot: int) -> str:
    if slot == 0:
        return "free"
    return f"{_patient(patient, slot)} (nurse {patient['nurse']}{'' if patient['attended'] else ', NO CARE'})"


def _nurse(simulator: WardSimulator, env_index: int, n: int) -> str:
    nurse = simulator.state.nurses[env_index, n]
    what = f"takes over {nurse['patient']}, {nurse['busy']} left" if nurse["busy"] else f"load {nurse['load']}"
    return f"nurse {n} (section {nurse['home']}): {what}"


def timeline(simulator: WardSimulator, env_index: int = 0) -> np.ndarray:
    """What every bed held in every quarter of an hour so far, uint8 (height, width, 3), one band for each bed.

    The whole horizon is drawn, so that all pictures of an episode have one size. Raises InvalidOptionError if the
    simulator was made without `record_timeline`.
    """
    if not len(simulator.state.timeline):
        raise InvalidOptionError("render: the simulator was made without record_timeline=True")
    n_beds = simulator.state.rows["n_beds"][env_index]
    shown = simulator.state.timeline[env_index, :, :n_beds].T
    palette = np.array([FREE, *WITH_CARE, WITHOUT_CARE], np.uint8)
    image = palette[shown].repeat(CELL, axis=0).repeat(_QUARTER, axis=1)
    image[:, int(simulator.time[env_index]) * _QUARTER :] = 255
    image[CELL - 1 :: CELL] = 255
    return image

"""Problems that the tests of several environment APIs play."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.airme.instance import AirmeInstance

HORIZON = {"airme": 40, "murse": 2, "ward": 4}  # hours, rounds, hours


def fleet(n_planes, n_crews):
    """Healthy aircraft of one type."""
    return AirmeInstance(
        n_crews=n_crews,
        kind=np.zeros(n_planes, int),
        income=np.full(n_planes, 10.0),
        hours=np.full(n_planes, 24),
        landings=np.full(n_planes, 3),
        broken=np.zeros(n_planes, bool),
    )

"""What `marl-sched advise` tells of a fleet; see marl_sched.planning.Advice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_sched.envs.airme.dynamics import AVAILABILITY, PROFIT, REVENUE
from marl_sched.planning import Measure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from marl_sched.envs.airme.simulator import AirmeSimulator


class FleetAdvice:
    """Aircraft as choices, days as steps."""

    step, steps, appraiser = ("day", 24), 7, "index"

    def choices(self, simulator: AirmeSimulator, env_index: int) -> list[tuple[str, dict[str, Any]]]:
        """What each action is: nothing, then every aircraft with what is known of it."""
        instance, planes = simulator.instances[env_index], simulator.state.planes[env_index]
        told: list[tuple[str, dict[str, Any]]] = [("nothing", {})]
        for slot in range(1, instance.n_planes + 1):
            plane = planes[slot]
            name = instance.names[slot - 1] if instance.names else f"aircraft {slot}"
            risks = simulator.rules.failure[plane["kind"], :, :]
            counts = np.array([plane["landings"], *([plane["hours"]] * (len(risks) - 1))])
            risk = 1.0 - np.prod(1.0 - risks[np.arange(len(risks)), counts])
            told.append(
                (
                    name,
                    {
                        "type": simulator.types[plane["kind"]].name,
                        "state": "broken" if plane["broken"] else "flying" if plane["mission_hours"] else "ready",
                        "hours": int(plane["hours"]),
                        "landings": int(plane["landings"]),
                        "income": float(plane["income"]),
                        "risk of an hour %": None if plane["broken"] else round(100.0 * float(risk), 3),
                    },
                )
            )
        return told

    def outlook(self, simulator: AirmeSimulator) -> Mapping[str, Measure]:
        """Aircraft that are available, income and costs of repairs in each hour so far."""
        series, rows = simulator.state.series, simulator.state.rows
        income = series[:, :, REVENUE] * rows["total_income"][:, None]
        costs = (series[:, :, REVENUE] - series[:, :, PROFIT]) * rows["total_income"][:, None]
        return {
            "available aircraft": Measure(series[:, :, AVAILABILITY] * rows["n_planes"][:, None], "mean", "higher"),
            "income": Measure(income, "sum", "higher"),
            "repair costs": Measure(costs, "sum", "lower"),
            "profit": Measure(income - costs, "sum", "higher"),
        }

    def figure(self, episodes: Mapping[str, AirmeSimulator], until: int, env_index: int) -> Figure:
        """The timelines of one row of each simulator."""
        from marl_sched.envs.airme.timeline_figure import episode_figure

        return episode_figure(episodes, until=until, env_index=env_index)


ADVICE = FleetAdvice()

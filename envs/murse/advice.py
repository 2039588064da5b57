"""What `marl-sched advise` tells of a plant; see marl_sched.planning.Advice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.schedule import schedule
from marl_sched.planning import Measure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from marl_sched.envs.murse.simulator import MurseSimulator


class PlantAdvice:
    """Tasks as choices, rounds as steps."""

    step, steps, appraiser = ("round", 1), 1, "lst-rollout"

    def choices(self, simulator: MurseSimulator, env_index: int) -> list[tuple[str, dict[str, Any]]]:
        """What each action is: waiting, then every task with what the acting agent would need for it."""
        instance, agent = simulator.instances[env_index], int(simulator.acting[env_index])
        tasks, _ = instance.called
        told: list[tuple[str, dict[str, Any]]] = [("wait", {})]
        for i, name in enumerate(tasks):
            planned = int(simulator.state.pairs[env_index, i, agent]["planned"]) if agent >= 0 else -1
            facts = {
                "duration": planned if planned >= 0 else None,
                "deadline": None if instance.deadlines[i] == NO_DEADLINE else int(instance.deadlines[i]),
                "after": ", ".join(tasks[j] for j, _ in instance.waits_by_task()[i]) or None,
            }
            told.append((name, facts))
        return told + [("", {})] * (simulator.max_actions - len(told))

    def outlook(self, simulator: MurseSimulator) -> Mapping[str, Measure]:
        """Feasibility, makespan of feasible rounds and adjusted makespan of every round so far."""
        rounds = simulator.per_round()
        return {
            "feasible": Measure(rounds["feasible"], "mean", "higher"),
            "makespan if feasible": Measure(rounds["makespan_feasible"], "mean", "lower"),
            "adjusted makespan": Measure(rounds["makespan"], "mean", "lower"),
        }

    def figure(self, episodes: Mapping[str, MurseSimulator], until: int, env_index: int) -> Figure:
        """The Gantt charts of the first round of one row of each simulator."""
        from marl_sched.envs.murse.gantt import gantt_figure

        return gantt_figure({name: schedule(simulator, env_index, 0) for name, simulator in episodes.items()})


ADVICE = PlantAdvice()

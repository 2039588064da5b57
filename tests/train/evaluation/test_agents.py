"""Figures of single agents, worked out by hand."""

import numpy as np
import pytest

from marl_sched.agents.playing import play
from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import get_domain
from marl_sched.envs.airme.instance import AirmeInstance
from marl_sched.train.evaluation.agents import fairness, joined_figures, summarise_agents
from marl_sched.train.evaluation.results import AgentFigure


@pytest.mark.parametrize(
    ("values", "index"),
    [([3.0, 3.0, 3.0], 1.0), ([1.0, 0.0, 0.0, 0.0], 0.25), ([0.0, 0.0], 1.0), ([1.0, 2.0, np.nan], 9 / 10)],
)
def test_fairness_is_jains_index(values, index):
    assert fairness(np.array(values)) == pytest.approx(index)


def test_figures_of_batches_with_other_padding_are_joined():
    parts = [{"x": np.array([[1.0, 2.0]])}, {"x": np.array([[4.0, np.nan, np.nan]])}]
    whole = joined_figures(parts, 2)
    assert whole["x"].shape == (2, 1, 3)
    summary = summarise_agents({"utilisation": whole["x"]})
    assert summary.figures["utilisation"] == AgentFigure(mean=7 / 3, least=2.5, greatest=3.0)
    assert summary.by_agent is None


def test_crews_figures_are_those_of_their_books():
    """Two broken planes and three crews: two work until their repairs end, the third is free with nothing to miss.

    Planes never fly (usage 0), so each job's hours are those that the crew is at work.
    """
    from dataclasses import replace

    from marl_sched.envs.airme.aircraft import FIXED_WING

    still = replace(FIXED_WING, usage=0.0)
    fleet = AirmeInstance(
        n_crews=3, kind=[0, 0], income=[5.0, 4.0], hours=[0, 0], landings=[0, 0], broken=[True, True], types=(still,)
    )
    simulator = get_domain("airme").simulator([fleet], horizon=40, seed=2)
    simulator.step(np.array([0]))  # crew 0 stays free for the first hour
    simulator.step(np.array([1]))
    simulator.step(np.array([0]))
    first = simulator.state.planes["job_hours"][0, 1]
    while simulator.acting[0] >= 0:
        simulator.step(np.array([2 if simulator.acting[0] == 2 and simulator.time[0] == 1 else 0]))
    figures = simulator.agent_figures()
    assert figures["repairs"].tolist() == [[0.0, 1.0, 1.0]]
    assert figures["utilisation"][0, :2].tolist() == [0.0, first / 40]
    assert figures["idle"][0, 0] == 1.0
    # In hour 0 crews 0 and 2 were free while plane 2 stood broken; in hour 1 crew 2 took it.
    assert figures["idle_with_work"].tolist() == [[1 / 40, 0.0, 1 / 40]]


def test_a_plants_figures_are_those_of_its_schedule():
    """One robot and one human, two tasks; the second waits 5 after the first and ends 4 after its deadline.

    Robot does task 1 in [0, 10), human task 2 in [15, 25), deadline 21: makespan 25.
    """
    from marl_sched.envs.murse.instance import INELIGIBLE, MurseInstance

    curves = np.zeros((2, 1, 6))
    curves[1, 0, 0] = 10
    plant = MurseInstance(
        robot_durations=[[10], [INELIGIBLE]], curves=curves, deadlines=[-1, 21], waits=[[1, 0, 5]],
        locations=np.zeros((2, 2)), weights=np.ones(2), learning="none", proximity="none", duration_range=(1, 50),
    )  # fmt: skip
    simulator = get_domain("murse").simulator([plant], horizon=1)
    play(create_scheduler("lst", "murse"), simulator)
    figures = {name: values[0].tolist() for name, values in simulator.agent_figures().items()}
    assert figures == {
        "utilisation": [10 / 25, 10 / 25],
        "idle": [15 / 25, 15 / 25],
        "waiting": [0.0, 15 / 25],
        "tasks": [1.0, 1.0],
        "tardiness": [0.0, 4.0],
        "late": [0.0, 1.0],
    }

"""The shipped checks pass for what ships, and fail for what breaks its promises."""

import numpy as np
import pytest

from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import get_domain
from marl_sched.envs.airme.simulator import AirmeSimulator
from marl_sched.problem import Problem
from marl_sched.testing import ConformanceError, check_domain, check_scheduler, check_turns, check_view

SHORT = {"airme": 6, "murse": 1}


@pytest.mark.parametrize("name", ["airme", "murse"])
def test_the_domains_that_ship_hold_to_the_contract(name):
    check_domain(name, horizon=SHORT[name], instances=1)


@pytest.mark.parametrize(("domain", "name"), [("airme", "random"), ("airme", "condition"), ("murse", "edf")])
def test_schedulers_that_ship_hold_to_theirs(domain, name):
    check_scheduler(domain, lambda: create_scheduler(name, domain), horizon=SHORT[domain])


class Forgetful(AirmeSimulator):
    """Lets time pass that it does not tell."""

    def step(self, actions):
        super().step(actions)
        self.elapsed[:] = 0


def test_time_that_is_not_told_is_noticed():
    instances = get_domain("airme").instances("small", 1, 0)
    with pytest.raises(ConformanceError, match="time grows by what elapsed"):
        check_turns(Forgetful(instances, horizon=30))


class Absent(AirmeSimulator):
    """Says that the last plane is not there, and shows it."""

    @property
    def presence(self):
        there = np.ones((self.batch, self.max_actions), bool)
        there[:, -1] = False
        return {"plane": there}


def test_a_node_that_is_shown_though_it_is_not_there_is_noticed():
    instances = get_domain("airme").instances("small", 1, 0)
    with pytest.raises(ConformanceError, match="plane: a node that is not there is not visible"):
        check_turns(Absent(instances, horizon=30))


class Stubborn(type(create_scheduler("random", "airme"))):
    """Chooses the last action, legal or not."""

    def choose(self, observation, uniform):
        return np.full(len(uniform), observation["action_mask"].shape[1] - 1)


def test_an_illegal_decision_is_noticed():
    with pytest.raises(ConformanceError, match=r"action \d+ is legal"):
        check_scheduler("airme", Stubborn, horizon=5)


def hours_beyond(reach):
    """Scrambles the hours of planes farther than `reach` from the agent."""

    def scramble(simulator, agent, rng):
        n = int(simulator.n_agents[0])
        for slot in range(1, int(simulator.state.rows["n_planes"][0]) + 1):
            apart = abs((slot - 1) % n - agent)
            if min(apart, n - apart) > reach:
                simulator.state.planes["hours"][0, slot] = rng.integers(1000)

    return scramble


def test_a_view_that_shows_what_it_should_hide_is_noticed():
    problem = Problem("airme", count=2, horizon=40, view={"kind": "local", "reach": 1})
    check_view(problem, hours_beyond(1), hours_beyond(0))
    with pytest.raises(ConformanceError, match="plane shows what the view hides"):
        check_view(problem, hours_beyond(0), hours_beyond(0))

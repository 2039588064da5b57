from __future__ import annotations

import numpy as np
import pytest

from marl_sched.agents.recurrent import LocalAgent, RecurrentScheduler
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError


class Alternating(RecurrentScheduler):
    """Takes the legal action whose rank is the number of its own decisions so far, and remembers their number."""

    name, memory_size = "alternating", 1

    def choose_recurrent(self, observation, memory, uniform):
        legal = np.asarray(observation["action_mask"]) != 0
        rank = memory[:, 0].astype(np.int64) % legal.sum(axis=1)
        return (legal.cumsum(axis=1) > rank[:, None]).argmax(axis=1), memory + 1


@pytest.fixture
def simulator():
    domain = get_domain("airme")
    return domain.simulator(domain.instances("small", 3, 0), horizon=30, view=domain.make_view("local"))


def test_every_agent_counts_its_own_decisions(simulator):
    policy, taken = Alternating(), np.zeros((3, simulator.max_agents))
    policy.start(simulator, np.ones(3, bool))
    while not simulator.over.all():
        rows = np.flatnonzero(simulator.acting >= 0)
        taken[rows, simulator.acting[rows]] += 1
        simulator.step(policy.decide(simulator))
    assert policy._memories is not None
    assert np.array_equal(policy._memories[..., 0], taken)
    assert taken.max() > 2


def test_a_new_episode_forgets_in_its_rows_alone(simulator):
    policy = Alternating()
    policy.start(simulator, np.ones(3, bool))
    for _ in range(8):
        simulator.step(policy.decide(simulator))
    policy.start(simulator, np.array([True, False, False]))
    assert policy._memories is not None
    assert not policy._memories[0].any()
    assert policy._memories[1].any()


def test_agents_by_themselves_choose_as_in_the_simulator(simulator):
    policy = Alternating()
    alone = [[LocalAgent(Alternating()) for _ in range(simulator.max_agents)] for _ in range(3)]
    policy.start(simulator, np.ones(3, bool))
    while not simulator.over.all():
        actions = policy.decide(simulator)
        seen = simulator.observe(simulator.acting)
        for row in np.flatnonzero(simulator.acting >= 0):
            own = {name: values[row] for name, values in seen.items()}
            assert alone[row][simulator.acting[row]].act(own) == actions[row]
        simulator.step(actions)


def test_an_agent_that_is_started_again_begins_with_an_empty_memory(simulator):
    agent = LocalAgent(Alternating())
    own = {name: values[0] for name, values in simulator.observe(simulator.acting).items()}
    first = [agent.act(own) for _ in range(3)]
    agent.reset()
    assert [agent.act(own) for _ in range(3)] == first
    assert len(set(first)) > 1


def test_a_scheduler_that_was_not_started_says_so(simulator):
    with pytest.raises(InvalidOptionError, match="expected start"):
        Alternating().decide(simulator)

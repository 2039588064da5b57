"""Plans are followed turn by turn, and made anew when they are spent or their next action is not legal."""

from __future__ import annotations

import numpy as np
import pytest

from marl_sched.agents.planning import SPENT, AgentPlanner, SequencePlanner
from marl_sched.agents.recurrent import LocalAgent
from marl_sched.errors import InvalidOptionError


class Ascending(AgentPlanner):
    """Plans the legal actions but 0, ascending, and counts its plans."""

    name, memory_size = "ascending", 3
    plans = 0

    def plan(self, observation, uniform):
        self.plans += len(uniform)
        found = [(np.flatnonzero(mask)[1:].tolist() + [SPENT] * 3)[:3] for mask in observation["action_mask"]]
        return np.array(found, np.int64)


def seen(*legal: int) -> dict[str, np.ndarray]:
    """An observation in which action 0 and these are legal, out of ten."""
    mask = np.zeros(10, np.int8)
    mask[[0, *legal]] = 1
    return {"action_mask": mask}


def test_an_agent_follows_its_plan_until_it_is_spent():
    """Planned 2 5 7; when the sight changes to 1 5 7 it goes on with 5 and 7, then plans 1 5 7 anew."""
    planner = Ascending()
    agent = LocalAgent(planner)
    assert agent.act(seen(2, 5, 7)) == 2
    assert [agent.act(seen(1, 5, 7)) for _ in range(3)] == [5, 7, 1]
    assert planner.plans == 2


def test_an_agent_plans_anew_when_its_next_action_is_not_legal_and_waits_where_nothing_is():
    planner = Ascending()
    agent = LocalAgent(planner)
    assert agent.act(seen(2, 5, 7)) == 2
    assert agent.act(seen(3, 7)) == 3
    assert planner.plans == 2
    assert [agent.act(seen()), agent.act(seen(4))] == [0, 4]


def test_an_agent_that_is_started_again_has_no_plan():
    agent = LocalAgent(Ascending())
    agent.act(seen(2, 5, 7))
    assert agent.remembered == 1
    agent.reset()
    assert agent.remembered == 0
    assert agent.act(seen(1, 5, 7)) == 1


def test_agents_of_a_batch_plan_as_each_alone():
    planner = Ascending()
    masks = np.stack([seen(2, 5)["action_mask"], seen(3)["action_mask"]])
    actions, left = planner.choose_recurrent({"action_mask": masks}, planner.initial_memory(2), np.zeros(2))
    assert actions.tolist() == [2, 3]
    assert left.tolist() == [[5, SPENT, SPENT], [SPENT] * 3]


def test_a_plan_of_another_length_is_refused():
    planner = Ascending()
    planner.memory_size = 4
    with pytest.raises(InvalidOptionError, match=r"expected actions of shape \(1, 4\), got \(1, 3\)"):
        LocalAgent(planner).act(seen(1))


class Team(SequencePlanner):
    """Agent 0 takes 1 then 2, agent 1 takes 3."""

    name = "team"
    plans = 0

    def sequences(self, simulator, env_index):
        self.plans += 1
        return {0: [1, 2], 1: [3]}


class Turns:
    """Stands for a simulator of one env: whose turn it is and what is legal."""

    batch, time = 1, np.zeros(1, np.int64)
    progress = np.zeros(1, np.int64)

    def __init__(self) -> None:
        self.acting, self.mask = np.zeros(1, np.int64), np.ones((1, 5), np.int8)

    def legal(self) -> np.ndarray:
        return self.mask


def test_a_team_follows_one_plan_and_the_whole_of_it_is_made_anew():
    planner, turns = Team(), Turns()
    planner.start(turns, np.ones(1, bool))

    def decide(agent: int, *illegal: int) -> int:
        turns.acting[0] = agent
        turns.mask = np.ones((1, 5), np.int8)
        turns.mask[0, list(illegal)] = 0
        return int(planner.decide(turns)[0])

    assert [decide(0), decide(1)] == [1, 3]
    assert planner.plans == 1
    assert decide(0, 2) == 1  # 2 is gone: all plan anew, from the beginning
    assert (planner.plans, decide(1), planner.plans) == (2, 3, 2)
    assert (decide(1, 3), planner.plans) == (0, 3)  # spent, and the new one is not legal either
    assert (decide(0), planner.plans) == (1, 3)
    planner.start(turns, np.ones(1, bool))
    assert (decide(0), planner.plans) == (1, 4)

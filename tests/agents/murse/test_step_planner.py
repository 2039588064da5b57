"""Schedules that are built step by step: the graph of a step, what is offered, and what networks make of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from marl_sched.agents.murse.exact import solve
from marl_sched.agents.murse.networks.robognn import EdgeAttention
from marl_sched.agents.murse.partial_schedule import PartialSchedule
from marl_sched.agents.murse.problem import Round
from marl_sched.agents.murse.step_graph import PLACEHOLDERS, SPEC, TASK, RoundFacts, StepGraphs
from marl_sched.agents.murse.step_learning import gathered_steps, step_costs, steps_of
from marl_sched.agents.murse.step_planner import PUBLISHED, Strategy, attempts_of, build_plans, choices_at, pick_agent
from marl_sched.agents.networks.planner import StepwiseNetwork
from marl_sched.agents.networks.registry import network_config
from marl_sched.domain import get_domain
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.graph import ACTION_MASK
from tests.murse.problems import problem

NETWORKS = {
    "schedulenet": {"width": 8, "heads": 2, "layers": 2, "hidden": 16},
    "robognn": {"width": 8, "heads": 2, "layers": 2, "hidden": 16},
}


def network(name: str, seed: int = 0) -> StepwiseNetwork:
    """An untrained network whose worths differ by much more than rounding."""
    torch.manual_seed(seed)
    made = network_config({"name": name, **NETWORKS[name]}).build(SPEC)
    assert isinstance(made, StepwiseNetwork)
    *_, weight, _ = made.parameters()
    torch.nn.init.normal_(weight)
    return made


def instances(scale: str = "heterogeneous-5-small", count: int = 1) -> list[MurseInstance]:
    return get_domain("murse").instances(scale, count, 5, "validation")


def graphs_of(instance: MurseInstance, dispatched: list[tuple[int, int]], strategy: Strategy) -> StepGraphs:
    """The graph of the choice after some tasks were dispatched."""
    facts = RoundFacts.of(instance)
    schedule = PartialSchedule.of(facts.problem)
    for task, agent in dispatched:
        schedule.append(task, agent)
    graphs = StepGraphs([facts], 1)
    graphs.write(0, facts, schedule, *choices_at(schedule, strategy))
    return graphs


def worths(net: StepwiseNetwork, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Of the task nodes of a lone graph, float64 (N + 2,), -inf where a task is not offered."""
    tensors = {
        name: torch.from_numpy(array.astype(np.float64) if array.dtype == np.float32 else array)
        for name, array in arrays.items()
    }
    with torch.inference_mode():
        found = net.double()(tensors)[0].numpy()
    return np.where(arrays[ACTION_MASK][0] != 0, found, -np.inf)


def test_graph_of_17_tasks_and_5_robots_has_the_published_sizes():
    # The instance of figure 2.7 in the published code has these counts: all edges but s0's and f0's to the robots.
    rng = np.random.default_rng(0)
    grid = np.array([(x, y) for x in range(1, 4) for y in range(1, 4)], float)
    places = np.concatenate([grid, grid[rng.integers(9, size=8)]])
    waits = [(1, 11, 3), (3, 14, 8), (5, 14, 8), (6, 7, 7), (16, 9, 4)]
    instance = problem(rng.integers(1, 11, (17, 5)).tolist(), locations=places, waits=waits, proximity="distance")
    arrays = graphs_of(instance, [], "first").arrays
    assert arrays["task_mask"].sum() == 19
    assert arrays["place_mask"].sum() == 9
    assert arrays["agent_mask"].sum() == 5
    assert arrays[ACTION_MASK].sum() == 12  # the five that wait cannot start
    assert arrays["temporal"].sum() == 361
    assert (arrays["location"] >= 0).sum() == 17
    assert arrays["near"].sum() == 33
    assert arrays["take_time"].sum() == arrays["use_time"].sum() == 85
    assert arrays["assigned_to"].sum() == 0


def test_features_are_times_in_units_of_the_mean_duration():
    instance = problem([[4, 2], [2, 4]], deadlines=[-1, 7], locations=[[0, 0], [0, 0]], proximity="location")
    arrays = graphs_of(instance, [], "first").arrays  # the mean duration is 3, robot 1 chooses
    tasks = arrays["task"][0, PLACEHOLDERS:]
    assert tasks[:, TASK.index("duration")] == pytest.approx([4 / 3, 2 / 3])
    assert tasks[:, TASK.index("regret")] == pytest.approx([2 / 3 / 2, 0.0])
    # Task 2 has to start by 7 - 4 in the network, which counts the longest duration, and by 7 - 2 backwards.
    assert tasks[1, TASK.index("latest_start")] == pytest.approx(5 / 3 / 2)
    assert tasks[1, TASK.index("backward_start")] == pytest.approx(5 / 3 / 2)
    # If task 1 is taken now it ends at 4, one before task 2 has to start.
    assert tasks[0, TASK.index("lateness")] == pytest.approx(-1 / 3 / 2)
    assert tasks[:, TASK.index("dated")].tolist() == [0, 1]


def test_strategies_pick_the_agents_that_section_4_2_2_names():
    # Tasks 1 and 2 can start, 3 waits. Means of open tasks: 5, 4, 6; least: 2, 4, 1; means of startable: 3, 4, 8.5.
    durations = [[2, 4, 8], [4, 4, 9], [9, 4, 1]]
    schedule = PartialSchedule.of(Round.of(problem(durations, waits=[(2, 0, 1)])))
    assert [pick_agent(schedule, strategy, 0) for strategy in PUBLISHED] == [0, 1, 2, 0]


def test_active_choices_leave_a_task_to_the_agent_that_ends_it_sooner():
    schedule = PartialSchedule.of(Round.of(problem([[2, 9], [3, 9], [9, 4]])))
    schedule.append(0, 0, in_order=False)
    choices, now = choices_at(schedule, "active")
    assert (choices.tolist(), now) == ([-1, 0, 1], 0)  # task 2 at 2 on robot 1, before task 3 would end at 4


@pytest.mark.parametrize("strategy", [*PUBLISHED, "active"])
@pytest.mark.parametrize("look_ahead", [True, False])
def test_plans_hold_every_constraint_or_say_that_they_do_not(strategy, look_ahead):
    rounds = [RoundFacts.of(instance) for instance in instances(count=6)]

    def backward(arrays: dict[str, np.ndarray]) -> np.ndarray:
        return -arrays["task"][..., TASK.index("backward_start")]

    plans = build_plans(rounds, (strategy,), backward, look_ahead=look_ahead)
    assert any(plan.feasible for plan in plans)
    for facts, plan in zip(rounds, plans, strict=True):
        assert plan.feasible == (len(plan.tasks) == facts.problem.n_tasks)


def moved(graphs: StepGraphs, tasks: np.ndarray, robots: np.ndarray, places: np.ndarray) -> dict[str, np.ndarray]:
    """The same graph with its nodes in another order, int64 (n,) each: which node stands where."""
    orders = {"task": tasks, "agent": robots, "place": places}
    out = dict(graphs.arrays)
    for name, order in orders.items():
        out[name], out[f"{name}_mask"] = out[name][:, order], out[f"{name}_mask"][:, order]
    for relation in SPEC.relations:
        if relation.pattern == "dense":
            for array in (relation.name, f"{relation.name}_attributes") if relation.attributes else (relation.name,):
                out[array] = out[array][:, orders[relation.target]][:, :, orders[relation.source]]
    for index, order in (("decider", robots), ("location", places)):
        ends = out[index][:, tasks]
        out[index] = np.where(ends >= 0, np.argsort(order)[ends], -1)
    out[ACTION_MASK] = out[ACTION_MASK][:, tasks]
    return out


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("strategy", ["mean_open", "active"])
def test_order_of_tasks_robots_and_places_changes_no_worth(name, strategy):
    (instance,) = instances()
    graphs, rng = graphs_of(instance, [(0, 1), (1, 4)], strategy), np.random.default_rng(1)
    tasks, robots, places = (rng.permutation(graphs.arrays[node].shape[1]) for node in ("task", "agent", "place"))
    net = network(name)
    before = worths(net, graphs.arrays)
    assert np.isfinite(before).sum() > 1
    np.testing.assert_allclose(worths(net, moved(graphs, tasks, robots, places)), before[tasks], rtol=1e-9)


@pytest.mark.parametrize("name", NETWORKS)
def test_padding_changes_no_worth(name):
    small, large = instances()[0], instances("homogeneous-10-medium")[0]
    facts = RoundFacts.of(small)
    schedule, net = PartialSchedule.of(facts.problem), network(name)
    alone, padded = StepGraphs([facts], 1), StepGraphs([facts, RoundFacts.of(large)], 1)
    for graphs in (alone, padded):
        graphs.write(0, facts, schedule, *choices_at(schedule, "active"))
    found = worths(net, padded.arrays)[: small.n_tasks + PLACEHOLDERS]
    np.testing.assert_allclose(found, worths(net, alone.arrays), rtol=1e-9)


def test_edge_attention_is_equations_3_10_and_3_11():
    torch.manual_seed(0)
    layer = EdgeAttention(4, 2, 3, 2, mean=False).double()
    nodes, edges = torch.randn(1, 1, 5, 4).double(), torch.randn(1, 5, 5, 2).double()
    gaps = torch.rand(1, 5, 5) < 0.3
    gaps[0].fill_diagonal_(False)
    expected = torch.zeros(5, 2, 3).double()
    for head in range(2):
        part = slice(3 * head, 3 * head + 3)
        w, w_e, a = layer.message.weight[part], layer.edge.weight[part], layer.attend[:, head].flatten()
        for i in range(5):
            sources = [j for j in range(5) if not gaps[0, i, j]]
            sent = [w @ nodes[0, 0, j] + w_e @ edges[0, i, j] for j in sources]
            pairs = [torch.cat([w @ nodes[0, 0, i], w @ nodes[0, 0, j], w_e @ edges[0, i, j]]) for j in sources]
            alpha = torch.stack([functional.leaky_relu(a @ pair, 0.2) for pair in pairs]).softmax(0)
            expected[i, head] = alpha @ torch.stack(sent)
    wanted: Tensor = functional.relu(expected.flatten(1) + layer.own(nodes[0, 0]))
    torch.testing.assert_close(layer(nodes, edges, gaps)[0, 0], wanted)


@pytest.mark.parametrize("name", NETWORKS)
def test_network_learns_the_optimal_schedule_of_one_instance(name):
    (instance,) = instances()
    optimum = solve(Round.of(instance), work_limit=5.0)
    assert optimum.status == "optimal"
    plan = optimum.plan
    order = np.lexsort((plan.agents, plan.finishes[plan.tasks], plan.starts[plan.tasks]))
    schedule = np.stack([plan.tasks[order], plan.agents[order], plan.starts[plan.tasks[order]]])
    net, steps = network(name), gathered_steps([steps_of(instance, schedule, 0.99)])
    observed = {name: torch.from_numpy(array) for name, array in steps.items() if name not in ("label", "return")}
    label, optimizer = torch.from_numpy(steps["label"]), torch.optim.Adam(net.parameters(), 5e-3)
    for _ in range(150):
        loss = functional.cross_entropy(net(observed), label)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (net(observed).argmax(1) == label).float().mean() > 0.9


def test_returns_of_a_schedule_add_up_to_its_makespan():
    instance = problem([[4, 4], [3, 3], [2, 2]])  # on two robots: 4, then 3 and 2
    schedule = np.array([[0, 1, 2], [0, 1, 1], [0, 0, 3]])
    steps = steps_of(instance, schedule, discount=1.0)
    # Undiscounted, the first step's return is minus the makespan of 5; the mean load, which is the horizon, is 4.5.
    assert steps["return"][0] == pytest.approx(-5 / 4.5)
    # After the first task the makespan is 4, of which a third was paid.
    second = [value for value, label in zip(steps["return"], steps["label"], strict=True) if label == 1 + PLACEHOLDERS]
    assert second[0] == pytest.approx(-(5 - 4 / 3) / 4.5)


def test_costs_of_choices_are_those_of_the_schedules_that_follow():
    # One robot, tasks of 4 and 3, the second due by 5. Taken first it ends at 3 and the other at 7; taken second it
    # ends at 7, two late: makespan 7, half of it for lateness, 2 for each unit, a tenth of what lacks to the mean
    # duration of 3.5 before the deadline, and a twentieth of the mean finish.
    instance = problem([[4], [3]], deadlines=[-1, 5])
    (attempt,) = attempts_of([RoundFacts.of(instance)], ["active"])
    assert attempt.advance()
    late_first, in_time = 7 * 1.5 + 2 * 2 + 0.1 * 5.5 + 0.05 * (4 + 7) / 2, 7 + 0.1 * 1.5 + 0.05 * (3 + 7) / 2
    assert step_costs(attempt) == pytest.approx([late_first, in_time])


@pytest.mark.parametrize("name", NETWORKS)
def test_explored_steps_have_a_cost_for_every_task_that_is_offered(name):
    steps = network(name).explored(instances(count=2), np.random.default_rng(0))
    assert len(steps["costs"]) == len(steps[ACTION_MASK]) > 10
    np.testing.assert_array_equal(np.isfinite(steps["costs"]), steps[ACTION_MASK] != 0)

"""HybridNet and the interactive HetGAT: encoder, cells, masks, decoding and the ensemble that plans rounds."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from marl_sched.agents.murse.lst import lst_plan
from marl_sched.agents.murse.networks.hybridnet.decoding import (
    AGENT,
    TASK,
    costs_along,
    draw_pairs,
    masked_log_probs,
    pair_log_probs,
)
from marl_sched.agents.murse.networks.hybridnet.encoder import (
    METAGRAPH,
    NODES,
    RELATIONS,
    DeepEdgeLayer,
    Edges,
    Graph,
    graph_of,
)
from marl_sched.agents.murse.networks.hybridnet.features import Features, features_of
from marl_sched.agents.murse.networks.hybridnet.network import Interactive, PairNetwork, Propagator
from marl_sched.agents.murse.networks.hybridnet.planner import HybridNetConfig, PairSequences, RoundPlanner
from marl_sched.agents.murse.networks.hybridnet.rounds import (
    Charges,
    Rounds,
    nothing_dispatched,
    present_rounds,
    schedule_costs,
    time_rows,
)
from marl_sched.agents.murse.networks.hybridnet.selectors import Board, Residual, ranks_of
from marl_sched.agents.murse.problem import Round, plan_cost, timed
from marl_sched.domain import get_domain
from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.envs.murse.simulator import MurseSimulator
from tests.murse.problems import problem, three_tasks

CHARGES = Charges(2.0, 0.5, 0.0)
SIZES = {"width": 3, "heads": 2, "layers": 2, "hidden": 6, "edge_width": 4}


def network(residual: Residual = "none", *, timed: bool = False, seed: int = 0) -> Propagator:
    torch.manual_seed(seed)
    return Propagator(**SIZES, residual=residual, timed=timed)


def interactive(seed: int = 0) -> Interactive:
    torch.manual_seed(seed)
    return Interactive(**SIZES, residual="rule")


def rounds_of(instances: list[MurseInstance]) -> Rounds:
    simulator = MurseSimulator(instances, horizon=1, durations="deterministic")
    return present_rounds(simulator, np.arange(len(instances)))


def small(count: int, seed: int = 3) -> list[MurseInstance]:
    return list(get_domain("murse").instances("small", count, seed))


def uniforms(rounds: Rounds, samples: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((len(rounds.sizes), samples, rounds.shape[1], 2))


def board_of(features: Features, net: PairNetwork) -> Board:
    """Where nothing is chosen yet, one schedule for each round."""
    ready = torch.from_numpy((features.task[..., 0] > 0) & ~features.waits.any(axis=2))[:, None]
    return Board(ready, ready.any(2), torch.from_numpy(features.eligible), ranks_of(features, 1, net.residual), None)


def test_a_layer_gives_what_its_equations_give_node_by_node():
    """The page's formula with loops over targets and sources, for one relation with attributes and one without."""
    torch.manual_seed(1)
    edge_sizes = {relation.key: len(relation.attributes) for relation in RELATIONS if relation.attributes}
    layer = DeepEdgeLayer(NODES, edge_sizes, width=3, heads=2, edge_width=4, merge=True).double()
    graph = graph_of(features_of(rounds_of(small(1)), nothing_dispatched(rounds_of(small(1)))))
    graph = Graph(
        {name: values.double() for name, values in graph.nodes.items()},
        {key: Edges(*[part.double() for part in edges]) for key, edges in graph.edges.items()},
        {key: values.double() for key, values in graph.attributes.items()},
    )
    out = layer(graph)

    def sent(relation, target: int) -> torch.Tensor:
        key = relation.key
        q = layer.own[relation.target](graph.nodes[relation.target])[0, target].view(2, 3)
        m = layer.message[key](graph.nodes[relation.source])[0].view(-1, 2, 3)
        bias = graph.edges[key].bias[0, 0]
        sources = [j for j in range(len(m)) if bias[min(target, len(bias) - 1), j] == 0]
        if not sources:
            return torch.zeros(2, 3, dtype=torch.float64)
        z = [torch.zeros(2, 3, dtype=torch.float64)] * len(m)
        if key in layer.edge_message:
            z = [layer.edge_message[key](graph.attributes[key][0, target, j]).view(2, 3) for j in range(len(m))]
        a = layer.attend[key]
        parts = [[q, m[j], z[j]][: len(a)] for j in sources]
        logits = torch.stack([sum((a[k] * part).sum(1) for k, part in enumerate(each)) for each in parts])
        alpha = functional.leaky_relu(logits, 0.2).softmax(0)
        return sum(alpha[k][:, None] * (m[j] + z[j]) for k, j in enumerate(sources))

    for node, target in (("task", 2), ("agent", 1), ("state", 0), ("location", 0)):
        total = layer.own[node](graph.nodes[node])[0, target].view(2, 3)
        total = total + sum(sent(relation, target) for relation in RELATIONS if relation.target == node)
        expected = layer.normalise[node](torch.relu(total).flatten())
        torch.testing.assert_close(out.nodes[node][0, target], expected, rtol=1e-9, atol=1e-9)
    edge = torch.relu(layer.edge["task_temporal_task"](graph.attributes["task_temporal_task"]))
    torch.testing.assert_close(out.attributes["task_temporal_task"], edge)


def test_the_chosen_agents_and_the_states_cells_go_on_as_one_lstm_each():
    """Two pairs for agent 0, one for agent 1: its cells are written back, and others stay as they are."""
    net, rounds = network(), rounds_of(small(1))
    features = features_of(rounds, nothing_dispatched(rounds))
    board, memory = board_of(features, net), net.begin(features, 1)
    first, pairs = memory, [(0, 0), (3, 1), (1, 0)]
    inputs: list[torch.Tensor] = []
    for task, agent in pairs:
        inputs.append(torch.cat([memory.tasks[0, task], memory.h_agents[0, 0, agent], memory.pairs[0, task, agent]]))
        memory = net.advance(memory, board, torch.tensor([[agent]]), torch.tensor([[task]]))

    def unrolled(cell: nn.LSTMCell, chosen: list[torch.Tensor], h: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        lstm = nn.LSTM(cell.input_size, cell.hidden_size)
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        lstm.load_state_dict({f"{name}_l0": getattr(cell, name) for name in names})
        return lstm(torch.stack(chosen)[:, None], (h.view(1, 1, -1), c.view(1, 1, -1)))[1][0].flatten()

    of_agent_0 = unrolled(net.agent_cell, [inputs[0], inputs[2]], first.h_agents[0, 0, 0], first.c_agents[0, 0, 0])
    torch.testing.assert_close(memory.h_agents[0, 0, 0], of_agent_0)
    of_state = unrolled(net.state_cell, inputs, first.h_state[0, 0], first.c_state[0, 0])
    torch.testing.assert_close(memory.h_state[0, 0], of_state)
    torch.testing.assert_close(memory.h_agents[0, 0, 2:], first.h_agents[0, 0, 2:], rtol=0, atol=0)


def test_renaming_tasks_and_agents_renames_the_logits():
    net, rounds = network(), rounds_of(small(1))
    features = features_of(rounds, nothing_dispatched(rounds))
    rng = np.random.default_rng(0)
    n, m = features.eligible.shape[1:]
    tasks, agents = rng.permutation(n), rng.permutation(m)
    renamed = Features(
        task=features.task[:, tasks],
        agent=features.agent[:, agents],
        location=features.location,
        pair=features.pair[:, tasks][:, :, agents],
        state=features.state,
        bound=features.bound[:, tasks][:, :, tasks],
        waits=features.waits[:, tasks][:, :, tasks],
        located=features.located[:, tasks],
        near=features.near,
        assigned=features.assigned[:, tasks][:, :, agents],
        eligible=features.eligible[:, tasks][:, :, agents],
        latest_rank=features.latest_rank[:, tasks],
        rule_position=features.rule_position[:, tasks],
        rule_agent=np.argsort(agents)[features.rule_agent[:, tasks]],
        rule_cost=features.rule_cost,
    )
    chosen = 1
    first, second = net.begin(features, 1), net.begin(renamed, 1)
    of_agents = net.agent_logits(first, board_of(features, net)), net.agent_logits(second, board_of(renamed, net))
    torch.testing.assert_close(of_agents[0][:, :, agents], of_agents[1], rtol=1e-4, atol=1e-5)
    named = torch.tensor([[agents[chosen]]]), torch.tensor([[chosen]])
    of_tasks = [
        net.task_logits(memory, board_of(seen, net), agent)
        for memory, seen, agent in zip((first, second), (features, renamed), named, strict=True)
    ]
    torch.testing.assert_close(of_tasks[0][:, :, tasks], of_tasks[1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "net", [network(), network("rule", timed=True), interactive()], ids=["pure", "timed", "hetgat"]
)
def test_drawn_schedules_hold_every_task_once_behind_what_it_awaits_by_someone_eligible(net: PairNetwork):
    """Problems of different sizes in one batch, sampled from networks that know nothing."""
    crowded = problem([[3, 0], [0, 2], [4, 4], [1, 0]], waits=[(0, 1, 2), (3, 0, 0)])
    instances = [*small(2), crowded, three_tasks()]
    rounds = rounds_of(instances)
    with torch.no_grad():
        drawn = draw_pairs(net, rounds, 5, uniforms=uniforms(rounds, 5))
    for k, instance in enumerate(instances):
        for orders in drawn.orders[k]:
            tasks, agents = orders[: instance.n_tasks].T
            assert sorted(tasks) == list(range(instance.n_tasks))
            assert instance.eligible[tasks, agents].all()
            place = np.argsort(tasks)
            assert all(place[i] > place[j] for i, j, _ in instance.waits)
            assert not orders[instance.n_tasks :].any()


@pytest.mark.parametrize(
    "net", [network(), network("rule", timed=True), interactive()], ids=["pure", "timed", "hetgat"]
)
def test_a_schedule_that_is_given_has_the_log_probability_with_which_it_was_drawn(net: PairNetwork):
    rounds = rounds_of([*small(3), three_tasks()])
    with torch.no_grad():
        drawn = draw_pairs(net, rounds, 3, uniforms=uniforms(rounds, 3))
        again = draw_pairs(net, rounds, 3, given=drawn.orders)
        cached = draw_pairs(net, rounds, 3, given=drawn.orders, seen=drawn.seen)
    for other in (again, cached):
        torch.testing.assert_close(other.log_probs, drawn.log_probs, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(other.entropies, drawn.entropies, rtol=1e-5, atol=1e-5)


def test_probabilities_of_all_schedules_of_a_problem_sum_to_one():
    """Two tasks, two agents: 2 orders x 4 assignments."""
    rounds = rounds_of([problem([[2, 3], [4, 5]])])
    schedules = [[(a, i), (1 - a, j)] for a in (0, 1) for i in (0, 1) for j in (0, 1)]
    for net in (network(), network("rule", timed=True), interactive()):
        with torch.no_grad():
            drawn = draw_pairs(net, rounds, 8, given=np.array([schedules]))
        assert float(drawn.log_probs.sum(2).double().exp().sum()) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    "net", [network(), network("rule", timed=True), interactive()], ids=["pure", "timed", "hetgat"]
)
def test_greedy_schedules_do_not_depend_on_the_batch(net: PairNetwork):
    instances = [*small(4), three_tasks()]
    with torch.no_grad():
        together = draw_pairs(net, rounds_of(instances)).orders
        for k, instance in enumerate(instances):
            alone = draw_pairs(net, rounds_of([instance])).orders
            np.testing.assert_array_equal(together[k, :, : instance.n_tasks], alone[0])


@pytest.mark.parametrize("timed_", [False, True])
def test_an_untrained_network_with_a_residual_is_no_worse_than_the_rule(timed_: bool):
    """By the cost of `lst-rollout`: what it corrects is the cheaper one of the rule's schedules."""
    instances = small(30)
    rounds = rounds_of(instances)
    partial = nothing_dispatched(rounds)
    with torch.no_grad():
        time_rows(rounds, partial, draw_pairs(network("rule", timed=timed_), rounds).orders[:, 0])
    costs = schedule_costs(partial.finish, rounds, False, CHARGES)[0]
    plans = [lst_plan(Round.of(instance)) for instance in instances]
    finishes = np.zeros_like(partial.finish)
    for k, plan in enumerate(plans):
        finishes[k, : len(plan.finishes)] = plan.finishes
    rule = schedule_costs(finishes, rounds, False, CHARGES)[0]
    assert costs.mean() <= rule.mean()


def test_schedules_are_timed_as_the_timetable_times_them():
    instances = small(6)
    rounds = rounds_of(instances)
    with torch.no_grad():
        orders = draw_pairs(network(), rounds, uniforms=uniforms(rounds, 1)).orders[:, 0]
    partial = nothing_dispatched(rounds)
    time_rows(rounds, partial, orders)
    _, late, makespans = schedule_costs(partial.finish, rounds, False, CHARGES)
    for k, instance in enumerate(instances):
        plan = timed(Round.of(instance), orders[k, : instance.n_tasks, TASK], orders[k, : instance.n_tasks, AGENT])
        np.testing.assert_array_equal(partial.finish[k, : instance.n_tasks], plan.finishes)
        assert (makespans[k], late[k] == 0) == (plan.makespan, plan.feasible)


def test_the_cost_of_a_schedule_charges_lateness():
    """Finishes 4 and 9, the second 2 after its deadline: 9 + 2 x 2 + 0.5 x 9; weighted (4 + 3 x 9) / 4 + the same."""
    rounds = rounds_of([problem([[4], [5]], deadlines=[-1, 7], weights=[1.0, 3.0])])
    finish = np.array([[4, 9]])
    costs, late, makespans = schedule_costs(finish, rounds, False, CHARGES)
    assert (costs[0], late[0], makespans[0]) == (17.5, 2, 9)
    assert schedule_costs(finish, rounds, True, CHARGES)[0][0] == 31.0 / 4.0 + 8.5


def test_masked_choices_have_no_probability_and_a_row_without_any_is_uniform():
    log_probs = masked_log_probs(
        torch.tensor([[[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0]]]), torch.tensor([[[True, False, True]], [[False] * 3]])
    )
    assert float(log_probs[0, 0, 1].exp()) == 0.0
    assert float(log_probs[0, 0, 2] - log_probs[0, 0, 0]) == pytest.approx(2.0, abs=1e-6)
    torch.testing.assert_close(log_probs[1, 0].exp(), torch.full((3,), 1 / 3))


def test_a_network_learns_one_schedule_by_heart():
    net, rounds = network(seed=2), rounds_of([three_tasks()])
    given = np.array([[[(1, 1), (0, 0), (2, 1)]]])
    optimizer = torch.optim.Adam(net.parameters(), lr=0.02)
    for _ in range(60):
        loss = -draw_pairs(net, rounds, given=given).log_probs.sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    np.testing.assert_array_equal(draw_pairs(net, rounds).orders, given)
    assert loss.item() < 0.2


def policy(**options: object) -> RoundPlanner:
    config = HybridNetConfig(**SIZES, residual="none", timed=False)
    torch.manual_seed(5)
    net = config.build(METAGRAPH)
    assert isinstance(net, PairSequences)
    return net.planner("drawn", None, **options)


def test_more_samples_and_the_round_before_never_make_a_plan_worse():
    """The candidates of fewer samples are among those of more, and the schedule before stays if nothing beats it."""
    instances = [replace(instance, n_rounds=2) for instance in small(3)]
    simulator = MurseSimulator(instances, horizon=2, durations="deterministic")
    rows, costs = np.arange(3), []
    for samples in (1, 4, 12):
        plans = policy(samples=samples).plans(simulator, rows)
        costs.append([plan_cost(Round.of(i), plan, "makespan") for i, plan in zip(instances, plans, strict=True)])
    assert all(more <= fewer for few, many in pairwise(costs) for fewer, more in zip(few, many, strict=True))
    planner = policy(samples=12, previous=True)
    first = planner.plans(simulator, rows)
    assert [plan.makespan for plan in first] == [plan.makespan for plan in plans]
    simulator.state.rows["round"][:] = 1  # other random numbers
    again = planner.plans(simulator, rows)
    for instance, before, after in zip(instances, first, again, strict=True):
        assert plan_cost(Round.of(instance), after, "makespan") <= plan_cost(Round.of(instance), before, "makespan")


def test_a_policys_rounds_are_the_same_in_a_batch_and_turn_by_turn():
    instances = small(2)
    whole = MurseSimulator(instances, horizon=1, durations="deterministic")
    planner = policy(samples=3)
    player = planner.epoch_player(whole)
    assert player is not None
    player(1)
    by_turn = MurseSimulator(instances, horizon=1, durations="deterministic")
    planner = policy(samples=3)
    planner.start(by_turn, np.ones(2, np.bool_))
    while not by_turn.over.all():
        by_turn.step(planner.decide(by_turn))
    np.testing.assert_array_equal(whole.objectives()["makespan"], by_turn.objectives()["makespan"])


def test_appraisals_end_at_what_a_schedule_costs_and_stand_still_while_the_rule_is_followed():
    rounds = rounds_of([*small(4), three_tasks()])
    net = network("rule", timed=True)
    with torch.no_grad():
        drawn = draw_pairs(net, rounds, 2, uniforms=uniforms(rounds, 2), appraise=True)
    assert drawn.appraisals is not None
    for s in range(2):
        partial = nothing_dispatched(rounds)
        time_rows(rounds, partial, drawn.orders[:, s])
        costs = schedule_costs(partial.finish, rounds, False, Charges(2.0, 0.5, 0.05))[0]
        np.testing.assert_allclose(drawn.appraisals[:, s, -1], costs, rtol=1e-12)
    alone = rounds_of([problem([[3], [2], [4]])])  # one agent: the rule's order never changes
    with torch.no_grad():
        followed = draw_pairs(net, alone, appraise=True).appraisals
    assert followed is not None
    np.testing.assert_allclose(followed, followed[0, 0, 0], rtol=1e-12)


@pytest.mark.parametrize(
    "net", [network(), network("rule", timed=True), interactive()], ids=["pure", "timed", "hetgat"]
)
def test_all_pairs_that_could_be_next_share_the_probability_and_the_chosen_one_has_its_own(net: PairNetwork):
    rounds = rounds_of([*small(2), three_tasks()])
    n = rounds.shape[1]
    with torch.no_grad():
        drawn = draw_pairs(net, rounds, 2, uniforms=uniforms(rounds, 2))
        every = pair_log_probs(net, rounds, drawn.orders, drawn.seen)
    chosen = torch.from_numpy(drawn.orders[..., AGENT] * n + drawn.orders[..., TASK])[..., None]
    for k, count in enumerate(rounds.sizes[:, 0].tolist()):
        torch.testing.assert_close(
            every[k, :, :count].gather(2, chosen[k, :, :count])[..., 0], drawn.log_probs[k, :, :count],
            rtol=1e-5, atol=1e-5,
        )  # fmt: skip
        torch.testing.assert_close(every[k, :, :count].exp().sum(2), torch.ones(2, count))


def test_pairs_cost_what_the_rule_makes_of_the_rest_and_the_best_is_no_worse_than_the_rule():
    """At the end nothing is left to complete: the last pair costs what the schedule does."""
    rounds = rounds_of([*small(3), three_tasks()])
    with torch.no_grad():
        drawn = draw_pairs(network("rule"), rounds, 1, uniforms=uniforms(rounds, 1), appraise=True)
    costs, n = costs_along(rounds, drawn.orders), rounds.shape[1]
    assert drawn.appraisals is not None
    for k, count in enumerate(rounds.sizes[:, 0].tolist()):
        assert (costs[k, 0, :count].min(axis=1) <= drawn.appraisals[k, 0, :count] + 1e-9).all()
        task, agent = drawn.orders[k, 0, count - 1]
        assert costs[k, 0, count - 1, agent * n + task] == pytest.approx(drawn.appraisals[k, 0, count])
        assert np.isinf(costs[k, 0, count:]).all()
    awaited = costs[3, 0, 0].reshape(-1, n)  # task 3 of three_tasks waits for task 1
    assert np.isinf(awaited[:, 2:]).all()
    assert np.isfinite(awaited[:2, :2]).all()

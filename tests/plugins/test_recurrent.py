"""A recurrent policy of a domain from outside: trained, resumed, exported, and deployed as processes with memories."""

import json
import shutil

import numpy as np
import pytest

LEARN = (
    "env=couriers-deployable", "view=near", "view.reach=2", "policy=lstm", "policy.hidden=16", "policy.units=16",
    "algorithm=gae", "algorithm.instances=8", "algorithm.turns=32", "algorithm.reward_centering=false",
    "algorithm.ppo.minibatch=64", "algorithm.ppo.epochs=4", "algorithm.ppo.learning_rate=5e-3",
    "algorithm.critic.layers=1", "validation.instances=8", "validation.every=8", "save_every=1",
    "updates=8",
)  # fmt: skip
FORGETS = 4  # decisions of courier 0 before it is started again
NEAR = {"kind": "near", "reach": 2}


@pytest.fixture
def trained(run, installed, tmp_path):
    """Eight updates in one go, and the run's folder as a crash in the seventh leaves it, resumed."""
    from marl_sched.train.callbacks import Callback
    from marl_sched.train.config import load_config
    from marl_sched.train.run import train

    whole, crashed = tmp_path / "whole", tmp_path / "crashed"

    class Copy(Callback):
        """Keeps the folder when the turns of the seventh update are there, before they are learned from."""

        def on_rollout(self, run, rollout):
            if run.counters.update == 6:
                shutil.copytree(whole, crashed)

    train(load_config([*LEARN, f"run_dir={whole}"]), [Copy()], quiet=True)
    assert run("resume", crashed).code == 0
    return whole, crashed


@pytest.mark.slow
def test_a_recurrent_policy_is_trained_resumed_exported_and_deployed(trained, run, tmp_path):
    """What is learned does not depend on the interruption; processes with memories play as one process does."""
    whole, crashed = trained
    once, twice = _tensors(whole), _tensors(crashed)
    assert once.keys() == twice.keys()
    assert all(np.array_equal(once[name], twice[name]) for name in once)
    assert any(name.startswith("optimizer.exp_avg.policy.cell") and once[name].any() for name in once)
    few = ("--instances", 2, "--episodes", 1)
    assert run("export", whole, "mine", "--out", tmp_path, *few).code == 0
    policy = tmp_path / "mine.safetensors"
    assert json.loads((tmp_path / "mine.json").read_text())["sizes"]["architecture"] == "lstm"
    assert _score(policy, "greedy") < 0.9 * _untrained(policy)

    ended = run(
        "deploy", "--env", "couriers-deployable", "--policy", policy, "--view", "near", "--reach", 2, "--seed", 3,
        "--json", tmp_path / "run.json",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    report = json.loads((tmp_path / "run.json").read_text())
    decisions, m1 = _in_one_process(policy, seed=3)
    assert [(said["agent"], said["action"]) for said in report["decisions"]] == decisions
    assert report["M1"] == m1
    assert [agent["memory"]["decisions"] for agent in report["agents"]] == [
        sum(agent["name"] == name for name, _ in decisions) for agent in report["agents"]
    ]


class DiedError(Exception):
    """What ends an agent of a test."""


def _save(folder, name):
    """A policy of the LSTM network with weights by which its memory matters; its path."""
    import torch

    from marl_sched.agents.networks.lstm import LstmNetwork
    from marl_sched.agents.policies.cards import PolicyCard
    from marl_sched.agents.policies.checkpoint import save_network
    from marl_sched.domain import get_domain

    network = LstmNetwork(get_domain("couriers-deployable").simulator.graph, hidden=8, layers=2, units=8)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(std=0.5, generator=generator)
        network.q[0].weight[:, 8:] *= 10  # of the cell's output
        network.cell.bias_ih[8:16] = 1.0  # of the forget gate
    card = PolicyCard(
        domain="couriers-deployable", objective="waiting", view=NEAR, graph=network.spec, sizes=network.sizes,
        command="none", git_hash="none", seed=0, scores={}, mode="sample",
    )  # fmt: skip
    save_network(folder / name, network, card)
    return str(folder / name)


@pytest.fixture(params=["memory", "plan"])
def carrying(request, installed, tmp_path):
    """A policy whose agents carry a memory, and one whose agents carry a plan."""
    return _save(tmp_path, "p.safetensors") if request.param == "memory" else "couriers.schedulers:Itinerary"


def _options(seed):
    from marl_sched.comms.options import WorldOptions
    from marl_sched.problem import Problem

    view = {"kind": "near", "reach": 4}
    problem = Problem("couriers-deployable", scale="city", count=1, seed=seed, view=view)
    return WorldOptions(problem=problem, deadline=30.0, ready_timeout=60.0)


def test_deployed_in_one_process_every_agent_decides_as_in_the_batch_and_by_itself(carrying):
    from marl_sched.agents.playing import play as play_alone
    from marl_sched.agents.registry import create_scheduler
    from marl_sched.comms.inproc import play

    options = _options(4)
    simulator = options.simulator()
    report = play(options, [carrying] * int(simulator.n_agents[0])).as_json()
    play_alone(create_scheduler(carrying, options.domain), simulator)
    assert report["M1"] == float(simulator.objectives()["waiting"][0])
    assert report["rewards"] == _alone(carrying, options)[1]
    assert next(event["day"] for event in report["events"] if event["event"] == "memory began") == 0
    assert all(agent["memory"]["decisions"] == agent["turns"] for agent in report["agents"])
    assert all("empty_memory" not in agent["counts"] for agent in report["agents"])


def test_an_agent_that_is_started_again_begins_with_an_empty_memory_and_says_so(carrying, caplog):
    """Courier 0 dies as it says its fifth decision; its successor takes the same turn, with nothing remembered."""
    from marl_sched.comms.inproc import Threads

    options = _options(4)
    run = Threads(options, [carrying] * int(options.simulator().n_agents[0]))
    said, once = [], run.run_agent

    def die(key, payload):
        said.append(key)
        if sum(key.endswith("/decision") for key in said) == FORGETS + 1:
            raise DiedError

    def run_agent(index):
        if index == 0:
            run.nodes[0].on_put = die
            once(0)
            run.nodes[0] = run.bus.node()
        once(index)

    run.run_agent = run_agent
    report = run.play().as_json()
    assert [type(error) for error in run.errors] == [DiedError]
    actions, rewards = _alone(carrying, options, forgets_at=FORGETS)
    if carrying.endswith(".safetensors"):
        assert actions != _alone(carrying, options)[0]  # what it had remembered matters
    assert [(said["agent"], said["action"]) for said in report["decisions"]] == actions
    assert report["rewards"] == rewards
    first = report["agents"][0]
    began = [e["day"] for e in report["events"] if (e["agent"], e["event"]) == ("courier_0", "memory began")]
    assert len(began) == 2
    assert first["memory"] == {"began": began[1], "decisions": first["turns"] - FORGETS - 1}
    assert first["counts"]["empty_memory"] == 1
    assert f"begins with an empty memory at {began[1]}" in caplog.text


def _alone(policy, options, forgets_at=None):
    """Each agent by itself on the simulator: (agent, action) of every decision and the rewards.

    Agent 0 forgets before its decision number `forgets_at`, counted from 0.
    """
    from marl_sched.agents.recurrent import LocalAgent
    from marl_sched.agents.registry import create_scheduler

    simulator, domain = options.simulator(), options.domain
    agents = [LocalAgent(create_scheduler(policy, domain)) for _ in range(simulator.max_agents)]
    decisions, rewards, own = [], [], 0
    while not simulator.over[0]:
        agent = int(simulator.acting[0])
        if agent == 0:
            if own == forgets_at:
                agents[0].reset()
            own += 1
        seen, noise = simulator.observe(simulator.acting), simulator.policy_noise(simulator.acting)
        action = agents[agent].choose(seen, float(noise[0]))
        decisions.append((domain.agent_name(agent), action))
        simulator.step(np.array([action]))
        rewards.append(float(simulator.reward[0]))
    return decisions, rewards


def _tensors(run_dir):
    """Everything that a run has learned and where it stands, name -> array."""
    from safetensors.numpy import load_file

    (path,) = run_dir.glob("checkpoint-*.safetensors")
    best = {f"best.{name}": array for name, array in load_file(run_dir / "policy.safetensors").items()}
    return {**load_file(path), **best}


def _score(policy, mode):
    from marl_sched.agents.registry import load_policy

    return _waiting(load_policy(policy, mode=mode))


def _untrained(policy):
    """A network of the same sizes that has learned nothing: it chooses among all legal actions nearly alike."""
    from marl_sched.agents.policies.checkpoint import load_network
    from marl_sched.agents.policies.network_policy import policy_of

    network, _ = load_network(policy)
    return _waiting(policy_of(network.config.build(network.spec), mode="sample"))


def _waiting(policy):
    from marl_sched.problem import Problem
    from marl_sched.train.evaluation.evaluate import evaluate_scheduler

    problem = Problem("couriers-deployable", count=24, seed=5, view=NEAR)
    return float(evaluate_scheduler(problem, policy).measures["waiting"].mean())


def _in_one_process(policy, seed):
    """Each agent by itself in the AEC API: (agent, action) of every decision, and M1."""
    from marl_sched.agents.recurrent import LocalAgent
    from marl_sched.agents.registry import load_policy
    from marl_sched.envs.api.aec import SchedulingAEC
    from marl_sched.problem import Problem

    problem = Problem("couriers-deployable", count=1, seed=seed, view=NEAR)
    env = SchedulingAEC(
        "couriers-deployable", scale=problem.pad, view=NEAR, split="test", instance=problem.instances[0]
    )
    env.reset(seed=seed)
    agents = {name: LocalAgent(load_policy(policy)) for name in env.agents}
    decisions = []
    for name in env.agent_iter():
        observation, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        action = agents[name].act(observation)
        decisions.append((name, action))
        env.step(action)
    return decisions, float(env.simulator.objectives()["waiting"][0])

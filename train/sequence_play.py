"""What algorithms share that learn from whole sequences of choices: their networks, and an update's instances."""

from __future__ import annotations

from marl_sched.agents.networks.sequences import SequenceNetwork
from marl_sched.domain import get_domain
from marl_sched.errors import InvalidOptionError
from marl_sched.simulation import TurnSimulator
from marl_sched.train.algorithms.base import Setup
from marl_sched.train.device import device_of


def sequence_network(setup: Setup) -> SequenceNetwork:
    """A freshly drawn network that draws sequences, on the CPU.

    Raises InvalidOptionError for another kind of network, another collector than sync, and on a GPU.
    """
    config = setup.config
    name = config.algorithm.algorithm_name()
    if config.collector.name != "sync":
        raise InvalidOptionError(
            f"train: collector: {name} plays sequences in this process: expected sync, got {config.collector.name}"
        )
    domain = get_domain(config.env.name)
    network = setup.policy_for(setup.problem(domain.default_scale, count=1).simulator())
    if not isinstance(network, SequenceNetwork):
        raise InvalidOptionError(
            f"train: policy: {name} is for networks that draw sequences, got {config.policy.network_name()}"
        )
    if device_of(network).type != "cpu":
        raise InvalidOptionError(f"train: device: {name} draws on the CPU: expected device=cpu")
    return network


def instances_of_update(setup: Setup, update: int, instances: int, copies: int, rounds: int) -> TurnSimulator:
    """A simulator of an update's training instances, `copies` rows of each with the same noise.

    No two updates have an instance in common; scales take turns. `rounds` is the length of an episode.
    """
    scales = setup.config.env.scales
    problem = setup.problem(scales[update % len(scales)], horizon=rounds)
    drawn = [problem.instance(update * instances + k) for k in range(instances)]
    simulator = problem.simulator_of([instance for instance in drawn for _ in range(copies)], pad=None)
    simulator.reset(seed=problem.seed, episodes=problem.episode_numbers([update] * simulator.batch))
    return simulator

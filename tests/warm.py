"""Compiles a domain's kernels into the cache, so that the processes that run tests find them and do not each compile.

python -P tests/warm.py airme
"""

import sys

import numpy as np

from marl_sched.agents import create_scheduler
from marl_sched.agents.registry import rules
from marl_sched.domain import get_domain
from marl_sched.problem import Problem
from marl_sched.train.evaluation.evaluate import evaluate_scheduler

SLOW = {
    "exact",
    "exact-rolling",
    "genetic-edf",
    "genetic-published",
    "tercio",
    "lst-search",
}  # they compile nothing new


def warm(name: str) -> None:
    """Play a little under every view: turns with observations, as environments do, then every rule."""
    domain = get_domain(name)
    shortest = min(domain.default_horizon, 24)
    for kind in domain.views:
        simulator = Problem(name, count=2, horizon=shortest, view=kind).simulator()
        for turn in range(40):
            masks = simulator.legal()
            simulator.observe(np.maximum(simulator.acting, 0))
            simulator.observe_all()
            simulator.step(np.array([np.flatnonzero(mask)[turn % mask.sum()] for mask in masks]))
            if simulator.over.any():
                simulator.reset(simulator.over)
        simulator.objectives()
    problem = Problem(name, count=1, horizon=1, episodes=1)
    for rule in sorted(set(rules(domain)) - SLOW):
        evaluate_scheduler(problem, create_scheduler(rule, domain))


if __name__ == "__main__":
    warm(sys.argv[1])

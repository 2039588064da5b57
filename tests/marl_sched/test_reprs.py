"""What a user prints at a prompt says what it is, in one line."""

from __future__ import annotations

import pytest

from marl_sched.agents.registry import create_scheduler
from marl_sched.domain import get_domain
from marl_sched.envs import DOMAINS
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.gymnasium_env import SchedulingEnv
from marl_sched.envs.api.parallel import SchedulingParallel
from marl_sched.problem import Problem


@pytest.mark.parametrize("name", DOMAINS)
def test_instances_views_simulators_schedulers_environments_and_problems_print_themselves_in_one_line(name):
    torchrl_env = pytest.importorskip("marl_sched.envs.api.torchrl_env")
    domain = get_domain(name)
    problem = Problem(domain, count=2, horizon=3)
    things = {
        "given": Problem(domain, instances=problem.instances),
        "instance": problem.instances[0],
        "simulator": problem.simulator(),
        "scheduler": create_scheduler("random", domain),
        "aec": SchedulingAEC(domain, seed=1),
        "parallel": SchedulingParallel(domain, seed=1),
        "gymnasium": SchedulingEnv(domain, seed=1),
        "torchrl": torchrl_env.SchedulingTorchRL(domain, batch_size=2, seed=1),
        "problem": problem,
        **{f"view {kind}": domain.view(kind) for kind in domain.views},
    }
    for what, thing in things.items():
        text = repr(thing)
        assert text.startswith(f"{type(thing).__name__}("), what
        assert "\n" not in text
        assert len(text) < 250, what


def test_a_policy_a_problem_and_its_simulator_say_what_they_are():
    pytest.importorskip("torch")
    policy = create_scheduler("airme-local-profit", "airme")
    assert repr(policy) == "NetworkPolicy(airme-local-profit)"
    problem = Problem("airme", count=1, seed=4, view={"kind": "local", "reach": 1})
    assert repr(problem) == (
        "Problem(airme, 1 x small, seed 4, 10 episodes of 720 hours, profit, view local (reach 1, comm 1, staleness 0))"
    )
    assert (
        repr(problem.simulator())
        == "AirmeSimulator(1 env of 720 hours, view local (reach 1, comm 1, staleness 0), at 0)"
    )

"""The schedulers of the delivery ward by name."""

from __future__ import annotations

from collections.abc import Callable

from marl_sched.agents.base import Scheduler
from marl_sched.agents.ward.rollout import MarginalCostRollout
from marl_sched.agents.ward.rules import MarginalCost, RandomRule, first_come, least_slack, most_urgent

RULES: dict[str, Callable[..., Scheduler]] = {
    "random": RandomRule,
    "first-come": first_come,
    "most-urgent": most_urgent,
    "least-slack": least_slack,
    "marginal-cost": MarginalCost,
    "marginal-cost-rollout": MarginalCostRollout,
}

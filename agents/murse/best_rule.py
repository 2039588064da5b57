"""The best schedule that rules find: what solvers start from, and what they are never worse than."""

from __future__ import annotations

from marl_sched.agents.murse.dispatching import PRIORITY_RULES, dispatched
from marl_sched.agents.murse.lst import search_plan
from marl_sched.agents.murse.problem import Plan, Round, plan_cost

_EVALUATIONS = 64  # of the hill climb
_TASK_EVALUATIONS = 20_000  # fewer evaluations for problems of many tasks


def best_rule_plan(problem: Round, objective: str = "makespan") -> Plan:
    """The best plan of `lst`, a short hill climb on its keys and all priority rules; ties to the first.

    It may not be feasible, but then no rule's is. The same for the same problem.
    """
    evaluations = max(1, min(_EVALUATIONS, _TASK_EVALUATIONS // problem.n_tasks))
    plans = [
        search_plan(problem, evaluations=evaluations, objective=objective),
        *(dispatched(problem, rule) for rule in PRIORITY_RULES),
    ]
    return min(plans, key=lambda plan: plan_cost(problem, plan, objective))

"""Who decides: heuristics, exact solvers and learned policies, all of them schedulers.

from marl_sched.agents import create_scheduler, load_policy

rule = create_scheduler("preventive-first", "airme")
policy = load_policy("runs/mine/policy.safetensors")    # needs torch, importing this package does not
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marl_sched.agents.registry import create_scheduler as create_scheduler
    from marl_sched.agents.registry import load_policy as load_policy
    from marl_sched.agents.registry import scheduler_names as scheduler_names

__all__ = ["create_scheduler", "load_policy", "scheduler_names"]


def __getattr__(name: str) -> Any:
    """The public names, imported on first use (PEP 562)."""
    if name in __all__:
        return getattr(import_module("marl_sched.agents.registry"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))

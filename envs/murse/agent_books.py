"""What every agent did in the rounds that have ended."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.instance import NO_DEADLINE
from marl_sched.envs.murse.state import NOBODY, State


def executed_by_agent(state: State, n_agents: int) -> dict[str, np.ndarray]:
    """Sums over the ended rounds, name -> float64 (B, A), times in time units.

    busy: durations; last: the finish of the agent's last task; tasks; tardiness; late: number of tasks after their
    deadline. `span` float64 (B,) is the sum of the rounds' last finishes.
    """
    batch, n_rounds, _ = state.executed.shape
    ended = (np.arange(n_rounds) < state.rows["round"][:, None])[:, :, None]
    doer = np.where(ended, state.executed["agent"], NOBODY)
    start, finish = state.executed["start"].astype(np.float64), state.executed["finish"].astype(np.float64)
    done = doer != NOBODY
    deadline = state.tasks["deadline"][:, None, :]
    late = np.where(done & (deadline != NO_DEADLINE), np.maximum(finish - deadline, 0.0), 0.0)
    sums = {"busy": finish - start, "tasks": np.ones_like(start), "tardiness": late, "late": late > 0}
    found = {name: np.zeros((batch, n_agents)) for name in ("busy", "last", "tasks", "tardiness", "late")}
    for agent in range(n_agents):
        own = doer == agent
        for name, values in sums.items():
            found[name][:, agent] = np.where(own, values, 0.0).sum(axis=(1, 2))
        found["last"][:, agent] = np.where(own, finish, 0.0).max(axis=2).sum(axis=1)
    found["span"] = np.where(done, finish, 0.0).max(axis=2).sum(axis=1)
    return found

"""MuRSE's centralised interface: a whole schedule per round (dissertation, section 5.2.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

if TYPE_CHECKING:
    from marl_sched.envs.murse.simulator import MurseSimulator


class RoundSchedules:
    """A joint action is a list of pairs, int64 (N, 2): a task's slot, 0 for none, and its agent; one step is a round.

    In `plan` mode the list is the dispatch order of the round's plan. In `online` mode every agent takes its own
    tasks in that order, each when it is free, and waits while the next one cannot be dispatched yet. A pair that
    repeats a task, or is not eligible or not of this instance, is left out; the step's infos list its place
    under `illegal`.
    """

    def action_space(self, simulator: MurseSimulator) -> spaces.MultiDiscrete:
        """`MultiDiscrete([[N + 1, A]] * N)`, padded like the simulator."""
        n_tasks = simulator.max_actions - 2
        return spaces.MultiDiscrete(np.tile([n_tasks + 1, simulator.max_agents], (n_tasks, 1)))

    def action_masks(self, simulator: MurseSimulator) -> np.ndarray:
        """For each pair the slots of this instance's tasks, and 0, then its agents. Bool (N (N + 1 + A),)."""
        n_tasks, instance = simulator.max_actions - 2, simulator.instances[0]
        slots, agents = np.arange(n_tasks + 1) <= instance.n_tasks, np.arange(simulator.max_agents) < instance.n_agents
        return np.tile(np.concatenate([slots, agents]), n_tasks)

    def play(self, simulator: MurseSimulator, action: Any) -> tuple[float, dict[str, Any]]:
        """Play one round of row 0; its reward, and which pairs were left out."""
        tasks, agents, illegal = _usable(simulator, np.asarray(action, np.int64))
        if simulator.mode == "plan":
            simulator.play_round(0, tasks, agents)
            reward = float(simulator.reward[0])
        else:
            reward = _play_online(simulator, tasks, agents)
        result = simulator.round_results(0)[-1]
        infos = {name: result[name].item() for name in ("feasible", "makespan", "stuck")}
        return reward, {"illegal": illegal, **infos}


def _usable(simulator: MurseSimulator, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """The pairs that can be played, tasks and agents int64 (K,), and the places of those that cannot."""
    instance = simulator.instances[0]
    pairs: dict[int, int] = {}
    illegal = []
    for place, (slot, agent) in enumerate(action):
        task = int(slot) - 1
        if slot == 0:
            continue
        exists = task < instance.n_tasks and agent < instance.n_agents
        if exists and task not in pairs and instance.eligible[task, agent]:
            pairs[task] = int(agent)
        else:
            illegal.append(place)
    return np.array(list(pairs), np.int64), np.array(list(pairs.values()), np.int64), illegal


def _play_online(simulator: MurseSimulator, tasks: np.ndarray, agents: np.ndarray) -> float:
    """Let every agent work through its own tasks in real time; the round's reward."""
    queues = [[int(task) for task in tasks[agents == agent]] for agent in range(simulator.max_agents)]
    played, reward = simulator.state.rows["round"][0], 0.0
    while simulator.acting[0] >= 0 and simulator.state.rows["round"][0] == played:
        agent = int(simulator.acting[0])
        queue = queues[agent]
        ready = bool(queue) and simulator.dispatchable(0, queue[0], agent)
        simulator.step(np.array([queue.pop(0) + 1 if ready else 0]))
        reward += float(simulator.reward[0])
    return reward


CENTRAL = RoundSchedules()

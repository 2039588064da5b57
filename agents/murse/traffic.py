"""Counting what agents say to each other, by row and round."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.murse.simulator import MurseSimulator


class Traffic:
    """Messages and bytes of every row and round, int64 (B, R); a message counts once, whoever hears it."""

    def __init__(self) -> None:
        self.messages, self.bytes = np.zeros((0, 0), np.int64), np.zeros((0, 0), np.int64)

    def restart(self, simulator: MurseSimulator, envs: np.ndarray) -> None:
        """Set the counters of `envs`, bool (B,), to 0."""
        shape = (simulator.batch, simulator.horizon)
        if self.messages.shape != shape:
            self.messages, self.bytes = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        self.messages[envs], self.bytes[envs] = 0, 0

    def add(self, simulator: MurseSimulator, env_index: int, messages: int, size: int) -> None:
        """Count in the round that is being played."""
        now = int(simulator.state.rows["round"][env_index])
        self.messages[env_index, now] += messages
        self.bytes[env_index, now] += size

    def per_round(self) -> dict[str, np.ndarray]:
        """`messages` and `bytes`, float64 (B, R)."""
        return {"messages": self.messages.astype(np.float64), "bytes": self.bytes.astype(np.float64)}

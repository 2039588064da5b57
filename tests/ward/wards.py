"""Small wards of the tests."""

from __future__ import annotations

import numpy as np

from marl_sched.envs.ward.instance import Patient, WardInstance
from marl_sched.envs.ward.simulator import WardSimulator
from marl_sched.noise import episode_key, time_key, uniform


def ward(*patients, beds=(0,), nurses=(0,)):
    return WardInstance(beds=tuple(beds), nurses=tuple(nurses), patients=tuple(patients))


def waiting(stage, section=0, **options):
    return Patient(0, section, stage, **options)


def quiet_seed(instance, quarters):
    """The first seed under which nobody's stage ends within so many quarters: every draw is at least 1/4."""

    def quiet(seed):
        key = np.uint64(episode_key(np.uint64(seed), np.uint64(instance.identity), np.uint64(0)))
        draws = [
            uniform(np.uint64(time_key(key, t)), 16, slot, 0)
            for t in range(quarters)
            for slot in range(1, len(instance.patients) + 1)
        ]
        return min(draws) >= 0.25

    return next(seed for seed in range(100_000) if quiet(seed))


def quiet(instance, hours=1, **options):
    """A simulator in which no stage ends within the horizon."""
    return WardSimulator([instance], horizon=hours, seed=quiet_seed(instance, 4 * hours), **options)


def play(simulator, *actions):
    """Take turns with these actions; the sum of rewards."""
    total = 0.0
    for action in actions:
        simulator.step(np.array([action]))
        total += float(simulator.reward[0])
    return total

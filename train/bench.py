"""How fast a domain's simulator, its environment APIs and the policy are on this machine, on one thread.

A figure is the best of several repeats in CPU time of the one thread, so that what else runs on the machine counts
as little as it can. Nothing is compiled, drawn or decided within a measurement that is not what it is of.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import torch
from msgspec import Struct

from marl_sched.agents.benchmark import own_benchmarks
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.policies.network_policy import NetworkPolicy
from marl_sched.domain import Domain
from marl_sched.envs.api.aec import SchedulingAEC
from marl_sched.envs.api.torchrl_env import SchedulingTorchRL
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.files import read_json
from marl_sched.graph import ACTION_MASK
from marl_sched.noise import Stream, uniforms
from marl_sched.simulation import TurnSimulator

SCHEMA = 2  # 1 had no calibration, its figures stood beside its head, and those of the policy below a scale's name
BATCH = 1024
SLOWER = 1.10  # a ratio from which on a figure counts as slower
_AEC_TURNS = 5_000
_TORCHRL_STEPS = 100
_POLICY_DECISIONS = 200
_CALIBRATION_ROWS, _CALIBRATION_TURNS, _CALIBRATION_PRODUCTS = 2**18, 20_000, 64
_MEANINGS = {
    "aec_turns_per_s": "AEC turns with observations, small instance, random legal choices: last() and step()",
    "torchrl_decisions_per_s": "decisions of a TorchRL batch of small instances with full observations, "
    "random legal choices: rand_action() and step_and_maybe_reset()",
    "policy_ms": "one decision of the default HetGAT policy at batch size 1 with a full view, observing included, "
    "milliseconds",
}


class Figure(Struct, frozen=True, forbid_unknown_fields=True):
    """What was measured, whether more of it is faster, and what it is of."""

    value: float
    better: Literal["higher", "lower"]
    meaning: str


class Bench(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The figures of a domain on one machine; as JSON what `marl-sched bench --json` writes and `--against` reads.

    Attributes:
        repeats, batch: see `bench`.
        statistic: how a figure follows from the repeats.
        calibration_ms: CPU milliseconds of work that never changes (`calibration`), to tell machines apart.
        figures: by their names.
    """

    schema: Literal[2] = 2
    env: str
    threads: int = 1
    repeats: int
    batch: int
    statistic: str = "best of repeats, CPU time"
    calibration_ms: float
    figures: dict[str, Figure]

    def against(self, earlier: Bench) -> dict[str, float]:
        """How much slower each figure is than an earlier one of the same name, 1 for as fast as then.

        Times are in units of each machine's calibration, so that a slower machine alone changes nothing. Raises
        InvalidOptionError for figures of another domain or batch.
        """
        for name in ("env", "batch"):
            now, then = getattr(self, name), getattr(earlier, name)
            if now != then:
                raise InvalidOptionError(f"bench: {name}: expected {now} as now, got figures of {then}")
        machine = self.calibration_ms / earlier.calibration_ms
        return {
            name: _slowdown(figure, earlier.figures[name]) / machine
            for name, figure in self.figures.items()
            if name in earlier.figures
        }


def _slowdown(now: Figure, then: Figure) -> float:
    return then.value / now.value if now.better == "higher" else now.value / then.value


def read_bench(path: Path) -> Bench:
    """What `marl-sched bench --json` wrote; InvalidFileError for another file, or one of another schema."""
    try:
        return msgspec.convert(read_json(path), Bench)
    except msgspec.ValidationError as error:
        raise InvalidFileError(path, "", f"figures of `marl-sched bench`, schema {SCHEMA} ({error})") from error


def bench(domain: Domain, *, repeats: int = 5, batch: int | None = None) -> Bench:
    """All figures of a domain, on one thread.

    `batch`: envs of what is measured in batches, None: BATCH; fewer for a simulator that is not compiled.
    """
    batch = BATCH if batch is None else batch
    if repeats < 1:
        raise InvalidOptionError(f"repeats: expected an integer >= 1, got {repeats}")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        before = calibration(repeats)
        figures = {
            name: Figure(each.per_second * _best(repeats, each.prepare, each.play), each.better, each.meaning)
            for name, each in own_benchmarks(domain, batch).items()
        }
        aec, torchrl = aec_turns_per_second(domain, repeats), torchrl_decisions_per_second(domain, repeats, batch)
        figures["aec_turns_per_s"] = Figure(aec, "higher", _MEANINGS["aec_turns_per_s"])
        figures["torchrl_decisions_per_s"] = Figure(torchrl, "higher", _MEANINGS["torchrl_decisions_per_s"])
        for scale in _scales(domain):
            decision = policy_milliseconds(domain, scale, repeats)
            figures[f"policy_ms_{scale}"] = Figure(decision, "lower", _MEANINGS["policy_ms"])
        calibrated = min(before, calibration(repeats))
    finally:
        torch.set_num_threads(threads)
    return Bench(env=domain.name, repeats=repeats, batch=batch, calibration_ms=calibrated, figures=figures)


def calibration(repeats: int) -> float:
    """CPU milliseconds of a fixed mixture of what figures are made of: compiled loops, Python, and products."""
    rows = np.arange(_CALIBRATION_ROWS)
    keys, square = rows.astype(np.uint64), torch.ones(128, 128)

    def play() -> None:
        uniforms(keys, rows, int(Stream.POLICY), rows, 0)
        told: dict[int, int] = {}
        for turn in range(_CALIBRATION_TURNS):
            told[turn % 97] = told.get(turn % 89, 0) + turn
        for _ in range(_CALIBRATION_PRODUCTS):
            square @ square

    return 1e3 * _best(repeats, lambda: None, play)


def _scales(domain: Domain) -> list[str]:
    """What is measured: the scales small and large, or of a domain without them its first and its last."""
    names = list(domain.scales)
    return ["small", "large"] if {"small", "large"} <= set(names) else [names[0], names[-1]]


def aec_turns_per_second(domain: Domain, repeats: int) -> float:
    """Turns of the AEC environment per second, each with an observation and a random legal choice."""
    env = SchedulingAEC(domain, scale=_scales(domain)[0])
    uniforms = np.random.default_rng(0).random(_AEC_TURNS)

    def play() -> None:
        for uniform in uniforms:
            observation, _, terminated, truncated, _ = env.last()
            if terminated or truncated:
                env.reset()
                continue
            legal = np.flatnonzero(observation[ACTION_MASK])
            env.step(int(legal[int(uniform * len(legal))]))

    return _AEC_TURNS / _best(repeats, lambda: env.reset(seed=0), play)


def torchrl_decisions_per_second(domain: Domain, repeats: int, batch: int) -> float:
    """Decisions per second of a TorchRL batch that is stepped without storing a rollout."""
    env = SchedulingTorchRL(domain, batch_size=batch, scale=_scales(domain)[0])
    state = {"now": env.reset()}

    def play() -> None:
        for _ in range(_TORCHRL_STEPS):
            _, state["now"] = env.step_and_maybe_reset(env.rand_action(state["now"]))

    return batch * _TORCHRL_STEPS / _best(repeats, lambda: None, play)


def policy_milliseconds(domain: Domain, scale: str, repeats: int) -> float:
    """Milliseconds of one decision of the default network, fresh, as a policy at batch size 1."""
    simulator: TurnSimulator = domain.simulator(domain.instances(scale, 1, 0), pad=scale)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = NetworkPolicy(HetGATNetwork(simulator.graph), domain=domain.name)

    def play() -> None:
        for _ in range(_POLICY_DECISIONS):
            simulator.step(policy.decide(simulator))

    return 1e3 / _POLICY_DECISIONS * _best(repeats, simulator.reset, play)


def _best(repeats: int, prepare: Callable[[], Any], play: Callable[[], Any]) -> float:
    """The least CPU seconds that `play` took, after one run that does not count: it compiles and fills caches."""
    seconds = []
    for _ in range(repeats + 1):
        prepare()
        started = time.thread_time()
        play()
        seconds.append(time.thread_time() - started)
    return min(seconds[1:])

"""What a turn of a deployment costs, beside a bare exchange over Zenoh of the same telemetry by as many processes.

The bare exchange has no protocol: the hub puts payloads of the sizes that the world would put, then asks, and agents
answer at once. What a deployment costs beyond that and beyond the policy's own time is this package's.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import msgspec
import zenoh

from marl_sched.comms.launcher import deploy
from marl_sched.comms.mind import decider_of
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.protocol.events import Choice, Outcome
from marl_sched.comms.transport.endpoints import settle_port
from marl_sched.comms.transport.zenoh_session import config_of
from marl_sched.errors import DeploymentError

TURN_BYTES, DECISION_BYTES = 500, 150  # of a message with its envelope
HEAD_BYTES = 90  # of the envelope of a channel's state
WAIT = 60.0  # seconds for a bare process to start or answer
_ROOT = "bare/"
Exchange = tuple[list[tuple[str, int]], list[int]]  # (channel, bytes) of what is told, and who is asked then


class DeploymentFigures(msgspec.Struct, frozen=True, kw_only=True):
    """What was measured; times of a turn in microseconds.

    Attributes:
        turn_us: of the deployment, from its first commit to its last.
        bare_turn_us: of the bare exchange.
        policy_us: of observing and choosing, in one process.
        overhead: (turn_us - policy_us) / bare_turn_us.
        ready_s: from the start of the deployment to its first turn.
    """

    env: str
    policy: str
    agents: int
    turns: int
    turn_us: float
    bare_turn_us: float
    policy_us: float
    overhead: float
    ticks_per_s: float
    ready_s: float
    latency_p99_ms: float | None


def measure(options: WorldOptions, policy: str) -> DeploymentFigures:
    """Play the run as processes, everybody deciding by `policy`, then the bare exchange of the same telemetry."""
    script, policy_s, channels = rehearse(options, policy)
    started = time.monotonic()
    report = deploy(DeployOptions(world=options, policy=policy))
    spent = time.monotonic() - started
    turns = len(report.decisions)
    turn_us = 1e6 * report.playing_s / max(turns - 1, 1)
    bare_us = 1e6 * bare_exchange(script, channels) / max(sum(len(asked) for _, asked in script), 1)
    return DeploymentFigures(
        env=options.domain.name,
        policy=policy,
        agents=len(channels),
        turns=turns,
        turn_us=round(turn_us, 1),
        bare_turn_us=round(bare_us, 1),
        policy_us=round(1e6 * policy_s, 1),
        overhead=round((turn_us - 1e6 * policy_s) / bare_us, 3),
        ticks_per_s=round(report.time / max(report.playing_s, 1e-9), 1),
        ready_s=round(spent - report.playing_s, 2),
        latency_p99_ms=report.latency_ms.p99,
    )


def rehearse(options: WorldOptions, policy: str) -> tuple[list[Exchange], float, list[list[str]]]:
    """What the run exchanges, the seconds of a decision in one process, and the channels of each agent."""
    plant, telemetry = options.simulated_plant(), options.telemetry()
    known = [telemetry.local_state(plant.frame, agent) for agent in range(plant.n_agents)]
    deciders = [decider_of(policy, options.domain) for _ in known]
    script: list[Exchange] = []
    spent, decisions, fresh = 0.0, 0, set(range(plant.n_agents))
    while not (state := plant.state()).over:
        script.append(([(c, len(p) + HEAD_BYTES) for c, p in state.changed.items()], [r.agent for r in state.requests]))
        for agent, local in enumerate(known):
            for channel in state.changed.keys() & set(local.channels):
                local.hear(channel, state.changed[channel])
            if agent in fresh:
                deciders[agent].rehearse(local)
                fresh.discard(agent)
        choices = []
        for request in state.requests:
            started = time.perf_counter()
            action, _ = deciders[request.agent].choose(known[request.agent], request.noise)
            spent, decisions = spent + time.perf_counter() - started, decisions + 1
            choices.append(Choice(request.agent, action, Outcome.DECIDED))
        plant.apply(choices)
    return script, spent / max(decisions, 1), [list(channels) for channels in plant.channels]


def bare_exchange(script: Sequence[Exchange], channels: Sequence[Sequence[str]]) -> float:
    """Seconds that the exchange takes, with this process as the hub and one process for each agent."""
    endpoint, answers = settle_port("tcp/127.0.0.1:0"), queue.SimpleQueue[int]()
    session = zenoh.open(config_of(endpoint, 1.0, None, mode="peer", listen={"endpoints": [endpoint]}))
    agents = []
    try:
        session.declare_subscriber(
            f"{_ROOT}decision/*", lambda sample: answers.put(int(str(sample.key_expr).split("/")[-1]))
        )
        for agent, heard in enumerate(channels):
            asked = json.dumps({"endpoint": endpoint, "agent": agent, "channels": list(heard)})
            command = [sys.executable, "-P", "-m", "marl_sched.comms.bench", asked]
            agents.append(subprocess.Popen(command, stdin=subprocess.PIPE))
        _gather(session, answers, len(agents))
        started = time.perf_counter()
        for told, asked_agents in script:
            for channel, size in told:
                session.put(_ROOT + channel, bytes(size), congestion_control=zenoh.CongestionControl.DROP)
            for agent in asked_agents:
                session.put(f"{_ROOT}turn/{agent}", bytes(TURN_BYTES), express=True)
            for _ in asked_agents:
                _answer(answers)
        return time.perf_counter() - started
    finally:
        for process in agents:
            process.communicate()
        session.close()


def _gather(session: zenoh.Session, answers: queue.SimpleQueue[int], n_agents: int) -> None:
    """Ask until everybody has answered, and nobody answers any more."""
    waiting, end = set(range(n_agents)), time.monotonic() + WAIT
    while waiting:
        if time.monotonic() > end:
            raise DeploymentError(f"bare exchange: agents {sorted(waiting)} did not start within {WAIT:g} s")
        for agent in waiting:
            session.put(f"{_ROOT}turn/{agent}", bytes(TURN_BYTES), express=True)
        time.sleep(0.2)
        while not answers.empty():
            waiting.discard(answers.get())
    time.sleep(0.5)
    while not answers.empty():
        answers.get()


def _answer(answers: queue.SimpleQueue[int]) -> None:
    try:
        answers.get(timeout=WAIT)
    except queue.Empty as error:
        raise DeploymentError(f"bare exchange: no answer within {WAIT:g} s") from error


def be_agent(endpoint: str, agent: int, channels: Sequence[str]) -> None:
    """A bare agent: hears what it may, answers when asked, until its standard input ends."""
    connect: dict[str, Any] = {"endpoints": [endpoint], "timeout_ms": int(WAIT * 1000), "exit_on_failure": True}
    session, asked = (
        zenoh.open(config_of(endpoint, 1.0, None, mode="client", connect=connect)),
        queue.SimpleQueue[bool](),
    )
    for channel in channels:
        session.declare_subscriber(_ROOT + channel, lambda sample: None)
    session.declare_subscriber(f"{_ROOT}turn/{agent}", lambda sample: asked.put(True))
    try:
        while asked.get():
            session.put(f"{_ROOT}decision/{agent}", bytes(DECISION_BYTES), express=True)
    finally:
        session.close()


if __name__ == "__main__":
    import os
    import threading

    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    be_agent(**json.loads(sys.argv[1]))

"""Holds a run's log and report against the invariants of PROTOCOL.md, by playing it again."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.decision_log import Accepted, Step, play_again, played, read_log
from marl_sched.comms.metrics.report import RunReport
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import IDLE
from marl_sched.comms.protocol.events import Outcome
from marl_sched.errors import InvalidFileError


def violations(world: WorldOptions, log: Path, before: bytes, report: RunReport) -> list[str]:
    """What in a run's log breaks an invariant, a sentence each; `before` is what the log held at an earlier moment.

    Every request of the plant has exactly one commit, no decision is applied twice, no target has two owners, no commit
    is lost, and the report says what the log does.
    """
    lines = read_log(log)
    steps = [line for line in lines if isinstance(line, Step)]
    found = _order(world, log, played(lines)) + _owners(steps)
    sources = Counter(source for step in steps for source in step.sources if source)
    found += [f"decision {source} was applied {n} times" for source, n in sources.items() if n > 1]
    if not log.read_bytes().startswith(before):
        found.append("a committed decision was lost: the log no longer begins with what it held")
    name = world.domain.agent_name
    logged = [(c.tick, name(c.agent), c.action, str(c.outcome)) for step in steps for c in step.commits]
    reported = [(d.time, d.agent, d.action, d.outcome) for d in report.decisions]
    if logged != reported:
        found.append(f"the report has {len(reported)} decisions that are not the log's {len(logged)}")
    return found


def _order(world: WorldOptions, log: Path, lines: list[Step | Accepted]) -> list[str]:
    """Each step must be the turns of those whose turn it was, and come out as it is written down."""
    try:
        play_again(world.plant(), lines, log)
    except InvalidFileError as error:
        return [f"played again it comes out otherwise: {error}"[:400]]
    return []


def _owners(steps: list[Step]) -> list[str]:
    owners: dict[tuple[int, int], int] = {}
    found = []
    for commit in (c for step in steps for c in step.commits):
        if commit.action == IDLE or commit.outcome != Outcome.DECIDED:
            continue
        owner = owners.setdefault((commit.tick, commit.action), commit.agent)
        if owner != commit.agent:
            found.append(f"time {commit.tick}: action {commit.action} has the owners {owner} and {commit.agent}")
    return found


def reference(world: WorldOptions, policy: str, until: int) -> tuple[list[tuple[str, int]], float]:
    """The (agent, action) pairs and the objective of the same run without messages, as far as time `until`."""
    simulator, domain = world.simulator(), world.domain
    schedulers = [create_scheduler(policy, domain) for _ in range(int(simulator.n_agents[0]))]
    decided = []
    while not simulator.over[0] and simulator.time[0] < until:
        agent = int(simulator.acting[0])
        action = schedulers[agent].decide(simulator)
        decided.append((domain.agent_name(agent), int(action[0])))
        simulator.step(action)
    return decided, float(simulator.objectives()[world.problem.objective][0])

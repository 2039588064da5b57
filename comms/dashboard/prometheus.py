"""A run's figures for Prometheus, made from what observers hear (marl_sched.comms.dashboard.watcher)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector

CONTENT_TYPE = CONTENT_TYPE_LATEST
PHASES = ("waiting", "gathering", "running", "standstill", "over")


def exposition(state: Mapping[str, Any]) -> bytes:
    """`RunState.as_dict` in Prometheus's text format; before the first message only that the world is waited for."""
    registry = CollectorRegistry()
    registry.register(_Run(state))
    return generate_latest(registry)


class _Run(Collector):
    """The metrics of one state; counters count from the start of the world's epoch."""

    def __init__(self, state: Mapping[str, Any]) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        """See Collector."""
        state = self._state
        phase = GaugeMetricFamily("marl_sched_phase", "1 for the phase that the run is in", labels=["run", "phase"])
        run = str(state.get("run", ""))
        for name in PHASES:
            phase.add_metric([run, name], float(state["phase"] == name))
        yield phase
        if "agents" not in state:
            return
        gauges = {
            "tick": ("simulated time", state["tick"]),
            "horizon": (f"length of the run in {state['unit']}s", state["horizon"]),
            "world_silent_seconds": ("since the world was last heard", state["silent_s"]),
            "decisions_per_second": ("decisions per second in the last seconds", state["decisions_per_s"]),
        }
        for name, (help_text, value) in gauges.items():
            gauge = GaugeMetricFamily(f"marl_sched_{name}", help_text, labels=["run"])
            gauge.add_metric([run], float(value))
            yield gauge
        decisions = CounterMetricFamily("marl_sched_decisions", "decisions that were applied", labels=["run"])
        decisions.add_metric([run], float(state["decisions"]))
        yield decisions
        yield from self._named(run)
        yield from self._agents(run)

    def _named(self, run: str) -> Iterator[Metric]:
        objectives = GaugeMetricFamily("marl_sched_objective", "mean over the run so far", labels=["run", "objective"])
        for name, value in self._state["objectives"].items():
            objectives.add_metric([run, name], float(value))
        yield objectives
        counts = CounterMetricFamily("marl_sched_events", "what the world counted, by kind", labels=["run", "kind"])
        for name, value in self._state["counts"].items():
            counts.add_metric([run, name], float(value))
        yield counts

    def _agents(self, run: str) -> Iterator[Metric]:
        agents = self._state["agents"]
        states = GaugeMetricFamily("marl_sched_agents", "agents by the state of their slots", labels=["run", "state"])
        for name, count in sorted(Counter(agent["state"] for agent in agents).items()):
            states.add_metric([run, name], float(count))
        yield states
        labels = ["run", "agent"]
        turns = CounterMetricFamily("marl_sched_agent_turns", "turns that an agent was asked for", labels=labels)
        losses = CounterMetricFamily("marl_sched_agent_losses", "how often an agent was lost", labels=labels)
        silent = GaugeMetricFamily("marl_sched_agent_silent_seconds", "since an agent was last heard", labels=labels)
        for agent in agents:
            turns.add_metric([run, agent["name"]], float(agent["turns"]))
            losses.add_metric([run, agent["name"]], float(agent["losses"]))
            silent.add_metric([run, agent["name"]], float(agent["silent_s"]))
        yield from (turns, losses, silent)

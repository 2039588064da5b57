"""A plant that is not simulated: telemetry that was recorded, played to agents who decide on it.

What the agents choose changes nothing; it is held against what was done when the recording was made. That is how a
policy is tried on a running plant before it may act there, and this file is what an adapter to a real plant looks
like: six attributes and methods (marl_sched.comms.plant.Plant).

Record a simulated run, then play the recording to agents of another policy, each a process:

    python examples/recorded_plant.py recording.jsonl
    export RECORDING=recording.jsonl PYTHONPATH=examples
    marl-sched deploy --env airme --view local --policy condition --plant recorded_plant:make --json run.json

The first line of a recording is {"frame": ..., "channels": ...}, every further one a decision epoch: {"tick": ...,
"asked": [[agent, noise], ...], "changed": {channel: payload}, "done": [action, ...]}, bytes in base64. A historian's
export is brought into that form by `telemetry.messages`, or by whatever writes the domain's messages.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from marl_sched.agents.registry import create_scheduler
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import Commit, PlantSummary
from marl_sched.comms.protocol.events import Choice, Outcome, PlantAdvanced, Request
from marl_sched.comms.protocol.messages import Operator, Work
from marl_sched.problem import Problem


class Head(msgspec.Struct):
    """What agents are told at the start, and which channels each of them may hear."""

    frame: bytes
    channels: list[list[str]]


class Epoch(msgspec.Struct):
    """What was known when agents were asked, and what was then done."""

    tick: int
    asked: list[tuple[int, float]]
    changed: dict[str, bytes]
    done: list[int]


class RecordedPlant:
    """Plays a recording; `agreed` counts the choices that are what was done."""

    simulated = False

    def __init__(self, path: Path, objective: str) -> None:
        head, *lines = path.read_bytes().splitlines()
        told = msgspec.json.decode(head, type=Head)
        self.frame, self.channels, self.n_agents = told.frame, told.channels, len(told.channels)
        self.epochs = [msgspec.json.decode(line, type=Epoch) for line in lines]
        self.at = self.agreed = self.asked = 0
        self._objective = objective

    def state(self) -> PlantAdvanced:
        """The next recorded decision epoch; a real plant says here what its sensors say."""
        epoch = self.epochs[min(self.at, len(self.epochs) - 1)]
        over = self.at >= len(self.epochs)
        requests = () if over else tuple(Request(agent, noise) for agent, noise in epoch.asked)
        return PlantAdvanced(epoch.tick, requests, {} if over else epoch.changed, over=over, progress=epoch.tick)

    def apply(self, choices: Sequence[Choice]) -> list[Commit]:
        """Compare the choices with what was done; a real plant gives its orders here."""
        epoch, self.at = self.epochs[self.at], self.at + 1
        commits = []
        for choice, done in zip(choices, epoch.done, strict=True):
            self.asked += 1
            self.agreed += choice.action == done
            said = {"agent": choice.agent, "action": choice.action, "outcome": choice.outcome}
            commits.append(Commit(tick=epoch.tick, reward=0.0, share=0.0, **said))
        return commits

    def order(self, order: Work | Operator) -> str:
        """A recording cannot be changed."""
        return "what is recorded cannot be changed"

    def objectives(self) -> dict[str, float]:
        """How often the agents chose what was done stands in for the objective, which nobody can know."""
        return {self._objective: self.agreed / max(self.asked, 1)}

    def summary(self) -> PlantSummary:
        """How far the recording goes, and how often the agents chose what was done."""
        time = self.epochs[-1].tick
        return PlantSummary(time=time, progress=time, objectives=self.objectives(), series={}, agent_figures={})


def make(options: WorldOptions) -> RecordedPlant:
    """The plant of the recording that the environment variable RECORDING names: what `--plant` asks for."""
    return RecordedPlant(Path(os.environ["RECORDING"]), options.problem.objective)


def record(path: Path, options: WorldOptions, policy: str) -> None:
    """Play a simulated plant to its end, everybody deciding by `policy`, and write down what agents were told."""
    plant, scheduler = options.simulated_plant(), create_scheduler(policy, options.domain)
    encode = msgspec.json.encode
    with path.open("wb") as file:
        file.write(encode(Head(plant.frame, [list(channels) for channels in plant.channels])) + b"\n")
        while not (state := plant.state()).over:
            request = state.requests[0]
            action = int(scheduler.decide(plant.simulator)[0])
            epoch = Epoch(state.tick, [(request.agent, request.noise)], state.changed, [action])
            file.write(encode(epoch) + b"\n")
            plant.apply([Choice(request.agent, action, Outcome.DECIDED)])


if __name__ == "__main__":
    record(Path(sys.argv[1]), WorldOptions(problem=Problem("airme", count=1, view="local", horizon=48)), "condition")

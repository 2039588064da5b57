"""The keys of a run. All start with `marl_sched/<run>/`; below, `crew` stands for the domain's name of an agent.

| Key | From, to | Carries |
|---|---|---|
| `world/frame` | query to the world | Frame |
| `world/snapshot/<id>` | query to the world by that agent | Snapshot |
| `world/clock` | world to all | Clock |
| `world/alive` | liveliness token of the world | |
| `world/observed` | world to observers | Observed |
| `world/command` | query to the world by an operator | Team, Work, Operator; Accepted, Declined |
| `<channel>` | world to those who may hear it | News |
| `crew/<id>/turn` | world to that agent | Turn, Welcome, Fenced, Refused |
| `crew/<id>/hello` | agent to world | Hello, Beat, Goodbye |
| `crew/<id>/decision` | agent to world | Decision |
| `crew/<id>/alive/<incarnation>` | liveliness token of one incarnation of an agent | |
"""

from __future__ import annotations

import re

from marl_sched.errors import InvalidMessageError, InvalidOptionError

CLOCK, FRAME, WORLD_ALIVE, OBSERVED = "world/clock", "world/frame", "world/alive", "world/observed"
COMMAND = "world/command"
INCARNATION = r"[0-9a-zA-Z-]{1,48}"
MAX_KEY = 256  # characters of a key that is looked at


def run_prefix(run: str) -> str:
    """What all keys of a run start with; InvalidOptionError if the name cannot be part of a key."""
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", run):
        raise InvalidOptionError(f"run: expected 1 to 64 letters, digits, '.', '_' or '-', got {run!r}")
    return f"marl_sched/{run}/"


def snapshot(agent: int | str) -> str:
    """By which an agent asks the world for the state of its channels; `*` for all."""
    return f"world/snapshot/{agent}"


def kind_of(key: str) -> str:
    """A key without its numbers, for counting: `plane/3/now` is of kind `plane/now`."""
    return "/".join(chunk for chunk in key.split("/") if not chunk.isdigit())


class AgentKeys:
    """The keys by which agents called `prefix` speak and are spoken to."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        agent = rf"{re.escape(prefix)}/([0-9]{{1,6}})"
        self._pattern = re.compile(rf"{agent}/(?:(hello|decision)|(alive)/({INCARNATION}))")

    def turn(self, agent: int | str) -> str:
        """World to agent."""
        return f"{self.prefix}/{agent}/turn"

    def hello(self, agent: int | str) -> str:
        """Agent to world; `*` for all."""
        return f"{self.prefix}/{agent}/hello"

    def decision(self, agent: int | str) -> str:
        """Agent to world; `*` for all."""
        return f"{self.prefix}/{agent}/decision"

    def alive(self, agent: int | str, incarnation: str) -> str:
        """Liveliness of an agent; `*` for all."""
        return f"{self.prefix}/{agent}/alive/{incarnation}"

    def parse(self, key: str) -> tuple[int, str, str]:
        """(agent, leaf, incarnation or "") of a key that an agent spoke by; InvalidMessageError for others."""
        match = self._pattern.fullmatch(key) if len(key) <= MAX_KEY else None
        if match is None:
            raise InvalidMessageError(f"{key[:60]}: not a key of an agent")
        return int(match[1]), match[2] or match[3], match[4] or ""

"""What a world, an agent and a whole deployment can be told, checked before anything starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_sched.comms.messages import run_prefix
from marl_sched.domain import Domain, Telemetry, get_domain
from marl_sched.envs import DOMAINS
from marl_sched.errors import InvalidOptionError, require

if TYPE_CHECKING:
    from marl_sched.simulation import TurnSimulator

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """The plant: which problem, how agents see it, and how long it waits for them.

    Attributes:
        env: a domain's name.
        scale: of the generated instance and of the padding.
        instance: an instance file, of no scale; "" generates the scale's first instance of `seed`.
        seed: of the instance's generator and of the noise.
        hours: simulated time of the run; 0: the domain's horizon.
        objective: what the run is rewarded for; "": the domain's first.
        view, view_options: what agents see.
        run: the run's name, part of every key.
        listen: endpoint, port 0 takes a free one.
        deadline: seconds that a decision may take; a late one idles the agent for this moment.
        patience: this many missed deadlines in a row make an agent count as dead: it is not asked any more. It
            may come back as another incarnation, which is given up at its first miss unless it has decided in time,
            until 2 x patience turns in a row were waited for in vain: then nobody may decide for it in this run. So
            between two decisions in time an agent delays the others by at most 2 x patience x deadline seconds; one
            that stays silent by patience x deadline, one whose process ends or freezes by at most a second, as its
            liveliness token goes.
        ready_timeout: seconds to wait for all agents at the start.
        report: file for the JSON report; "" writes none.
    """

    env: str = next(iter(DOMAINS))
    scale: str = "small"
    instance: str = ""
    seed: int = 0
    hours: int = 0
    objective: str = ""
    view: str = "full"
    view_options: Mapping[str, int | float] = field(default_factory=dict)
    run: str = "run"
    listen: str = DEFAULT_ENDPOINT
    deadline: float = 2.0
    patience: int = 3
    ready_timeout: float = 60.0
    report: str = ""

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        run_prefix(self.run)
        _require_positive(self, "deadline", "ready_timeout")
        if self.patience < 1:
            raise InvalidOptionError(f"patience: expected at least 1 missed deadline, got {self.patience}")
        if self.hours < 0 or self.seed < 0:
            raise InvalidOptionError(f"hours and seed: expected integers >= 0, got {self.hours} and {self.seed}")

    def domain(self) -> Domain:
        """The domain, or UnknownNameError."""
        return get_domain(self.env)

    def telemetry(self) -> Telemetry:
        """How the domain's state travels; InvalidOptionError if it cannot."""
        telemetry = self.domain().telemetry
        if telemetry is None:
            raise InvalidOptionError(f"env: {self.env} has no telemetry and cannot be deployed")
        return telemetry

    def simulator(self) -> TurnSimulator:
        """The plant's simulator, one row at the start of its episode; typed errors for options that do not fit."""
        domain = self.domain()
        view = domain.view(self.view, **self.view_options)
        domain.require_scale(self.scale)
        if self.instance:
            instance = domain.load(Path(self.instance))
        else:
            instance = domain.instances(self.scale, 1, self.seed)[0]
        return domain.simulator(
            [instance],
            view=view,
            objective=domain.require_objective(self.objective or domain.objectives[0]),
            horizon=self.hours or domain.default_horizon,
            seed=self.seed,
            pad=None if self.instance else self.scale,
        )


@dataclass(frozen=True, kw_only=True)
class AgentOptions:
    """One agent: who it is, what decides for it, and where its world is.

    Attributes:
        agent: its index.
        policy: a scheduler's name or a checkpoint's path.
        run, connect: the world's `run` and endpoint.
        join_timeout: seconds to wait for the world, at the start and when it has been lost.
    """

    agent: int
    policy: str
    run: str = "run"
    connect: str = DEFAULT_ENDPOINT
    join_timeout: float = 60.0

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        run_prefix(self.run)
        _require_positive(self, "join_timeout")
        if self.agent < 0:
            raise InvalidOptionError(f"agent: expected an index >= 0, got {self.agent}")


@dataclass(frozen=True, kw_only=True)
class DeployOptions:
    """A world and all its agents on this machine.

    Attributes:
        world: the plant's options.
        policy: what decides for every agent...
        agent_policies: ...but for these, agent's name -> policy.
    """

    world: WorldOptions = field(default_factory=lambda: WorldOptions(listen="tcp/127.0.0.1:0"))
    policy: str = "condition"
    agent_policies: Mapping[str, str] = field(default_factory=dict)

    def policies(self, n_agents: int) -> list[str]:
        """One policy per agent; UnknownNameError for an agent that does not exist."""
        domain = self.world.domain()
        names = [domain.agent_name(i) for i in range(n_agents)]
        for name in self.agent_policies:
            require(f"agent of this {domain.name} problem", name, names)
        return [self.agent_policies.get(name, self.policy) for name in names]


def _require_positive(options: Any, *names: str) -> None:
    for name in names:
        value = getattr(options, name)
        if not value > 0:
            raise InvalidOptionError(f"{name}: expected a number > 0 (seconds), got {value}")

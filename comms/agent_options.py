"""What an agent can be told, checked before anything starts. Imports nothing that a light agent lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from marl_sched.comms.logs import LogFormat
from marl_sched.comms.protocol.keys import run_prefix
from marl_sched.comms.security.identity import Identity
from marl_sched.comms.transport.faulty import Faults
from marl_sched.errors import InvalidOptionError, require
from marl_sched.light import Runtime

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, kw_only=True)
class AgentOptions:
    """One agent: who it is, what decides for it, and where its world is.

    Attributes:
        agent: its index.
        policy: a scheduler's name or a checkpoint's path.
        run, connect: the world's `run` and endpoint.
        certs: folder with the authority's certificate and this agent's, which a `tls/` endpoint needs.
        join_timeout: seconds to wait for the world, at the start and when it has been lost.
        lease: a link that is silent for that many seconds counts as dead.
        faults: what happens to its messages, see `Faults`.
        log_format: `text`, or `json`: one object a line, on stderr.
        runtime: `torch`, or `onnx`: networks run on onnxruntime, and what the agent sees and its rules are worked out
            without Numba where the domain has a light declaration (marl_sched.light).
    """

    agent: int
    policy: str
    run: str = "run"
    connect: str = DEFAULT_ENDPOINT
    certs: str = ""
    join_timeout: float = 60.0
    lease: float = 1.0
    faults: Mapping[str, float] = field(default_factory=dict)
    runtime: Runtime = "torch"
    log_format: LogFormat = "text"

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        run_prefix(self.run)
        Faults.of(self.faults)
        require("runtime", self.runtime, get_args(Runtime))
        require("log_format", self.log_format, get_args(LogFormat))
        require_positive(self, "join_timeout", "lease")
        if self.agent < 0:
            raise InvalidOptionError(f"agent: expected an index >= 0, got {self.agent}")

    def identity(self) -> Identity | None:
        """The agent's certificate, None without `certs`; InvalidOptionError for a folder that lacks it."""
        if not self.certs:
            return None
        found = sorted(path.stem for path in Path(self.certs).glob(f"*_{self.agent}.pem"))
        if len(found) != 1:
            what = f"one certificate of agent {self.agent}, such as crew_{self.agent}.pem"
            raise InvalidOptionError(f"certs: {self.certs}: expected {what}, found {', '.join(found) or 'none'}")
        return Identity(Path(self.certs), found[0])


def require_positive(options: Any, *names: str) -> None:
    """InvalidOptionError unless these options are numbers of seconds > 0."""
    for name in names:
        value = getattr(options, name)
        if not value > 0:
            raise InvalidOptionError(f"{name}: expected a number > 0 (seconds), got {value}")

"""A deployment to which things are done, and which is watched meanwhile as an observer would."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType

from marl_sched.comms.chaos.intruder import Order
from marl_sched.comms.chaos.proxy import Link
from marl_sched.comms.launcher import Deployment
from marl_sched.comms.metrics.report import RunReport
from marl_sched.comms.options import DeployOptions
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.events import Received
from marl_sched.comms.security.identity import OBSERVER, WORLD, Identity
from marl_sched.comms.transport.zenoh_session import ZenohTransport, spoke
from marl_sched.errors import MarlSchedError

POLL = 0.02  # seconds between two looks
START_TICK = 20  # the first faults come when the run has come so far
PATIENCE = 240.0  # seconds after which a run that does not go on has failed
STEADY = 2.0  # seconds for which agents that were heard again must stay so
PRESENT = ("ready", "asked")


class ChaosError(MarlSchedError):
    """A run did not get to where its case wanted it."""


class Scene:
    """A deployment, started and watched; what is done to it is counted in `faults`.

    Attributes:
        faults: kind -> how often.
        seen, seen_at: what the world last told observers, and when that came.
        heard_s: the longest time after a fault's end until every agent was heard again, None if nobody waited for it.
        before: what the run's log held when the world was last killed.
        link: which cut or slow link the agents in `behind` reach the world through, None for none.
    """

    def __init__(self, options: DeployOptions, behind: Callable[[int], Iterable[int]] = lambda n: ()) -> None:
        """`behind`: number of agents -> those behind a link."""
        self.deployment = Deployment(options)
        self.faults = Counter[str]()
        self.seen: wire.Observed | None = None
        self.seen_at, self.heard_s, self.before = 0.0, None, b""  # type: float, float | None, bytes
        self.link: Link | None = None
        self.intruders: dict[subprocess.Popen[str], list[str]] = {}  # what they said
        self._observer: ZenohTransport | None = None
        self._channels = tuple(options.world.plant().channels[0][:3])  # some that an agent may hear
        behind_link = sorted(behind(len(self.deployment.policies)))
        if behind_link:
            self.link = Link(self.deployment.endpoint)
            self.deployment.routes = dict.fromkeys(behind_link, self.link.endpoint)

    def __enter__(self) -> Scene:
        """Start all processes."""
        self.deployment.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all processes."""
        for intruder in self.intruders:
            intruder.kill()
            intruder.wait()
        if self._observer is not None:
            self._observer.close()
        self.deployment.__exit__()
        if self.link is not None:
            self.link.close()

    @property
    def names(self) -> list[str]:
        """All agents' names."""
        others = (WORLD, *self.deployment.router_names())
        return [name for name in self.deployment.children if name not in others]

    def start(self) -> None:
        """Wait until the run runs, and watch it from then on."""
        self.until(lambda: self.deployment.phase == "running" and self.deployment.tick >= START_TICK, "start")
        world = self.deployment.options.world
        identity = Identity(Path(self.deployment.certs), OBSERVER) if self.deployment.certs else None
        self._observer = spoke(world.run, self.deployment.endpoint, 10.0, identity=identity)
        self._observer.subscribe(keys.OBSERVED)
        self.until(lambda: self.seen is not None, "tell observers")

    def look(self) -> None:
        """Take in what has happened, for a moment."""
        self.deployment.look(POLL)
        now = time.monotonic()
        while self._observer is not None and isinstance(event := self._observer.receive(0), Received):
            self.seen, self.seen_at = wire.decode(event.payload, wire.Observed), now

    def go_on(self, seconds: float) -> None:
        """Let the run go on for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.look()

    def until(self, condition: Callable[[], bool], what: str, limit: float = PATIENCE) -> None:
        """Let the run go on until something is so; ChaosError after `limit` seconds."""
        end = time.monotonic() + limit
        while not condition():
            if time.monotonic() > end:
                raise ChaosError(f"the run did not {what} within {limit:g} s")
            self.look()

    def heard_again(self) -> None:
        """Wait until the world has heard every agent after this moment and time goes on, and note how long that took.

        What a link had held back is heard too, so it must stay so for STEADY seconds.
        """
        ended = time.monotonic()
        before = (self.seen.epoch, self.seen.decisions) if self.seen is not None else ("", 0)

        def heard() -> bool:
            seen = self.seen
            if seen is None or self.seen_at <= ended or (seen.epoch, seen.decisions) == before:
                return False
            return all(agent.state in PRESENT and self.seen_at - agent.silent > ended for agent in seen.agents)

        again: float | None = None
        while again is None or time.monotonic() < again + STEADY:
            if not heard():
                self.until(heard, "hear every agent again")
                again = time.monotonic()
            self.look()
        self.heard_s = max(self.heard_s or 0.0, again - ended)

    # ---- what is done to it

    def signal(self, names: Iterable[str], number: signal.Signals, kind: str) -> None:
        """Send processes a signal."""
        if WORLD in names and number == signal.SIGKILL:
            self.before = (self.deployment.folder / "run.jsonl").read_bytes()
        for name in names:
            self.deployment.signal(name, number)
            self.faults[kind] += 1

    def kill(self, *names: str) -> None:
        """Kill processes, which are started again, and wait until all agents are heard."""
        restarts = {name: self.deployment.children[name].restarts for name in names}
        self.signal(names, signal.SIGKILL, "killed")
        self.until(lambda: all(self.deployment.children[n].restarts > restarts[n] for n in names), "restart")
        self.heard_again()

    def freeze(self, name: str, seconds: float) -> None:
        """Stop a process for a while, and wait until all agents are heard."""
        self.signal([name], signal.SIGSTOP, "frozen")
        self.go_on(seconds)
        self.signal([name], signal.SIGCONT, "thawed")
        self.heard_again()

    def cut(self, seconds: float) -> None:
        """Cut the link for a while, and wait until all agents are heard."""
        link = self._link()
        link.cut()
        self.faults["cut"] += 1
        self.go_on(seconds)
        link.mend()
        self.heard_again()

    def slow_down(self, delay: float, seconds: float) -> None:
        """Let everything on the link come later for a while, and wait until all agents are heard."""
        link = self._link()
        link.delay = delay
        self.faults["slowed"] += 1
        self.go_on(seconds)
        link.delay = 0.0
        self.go_on(delay)  # what is under way still
        self.heard_again()

    def _link(self) -> Link:
        if self.link is None:
            raise ChaosError("no agent is behind a link")
        return self.link

    def intrude(self, what: str, seconds: float, *, certificate: bool = True) -> subprocess.Popen[str]:
        """Start an intruder, against the first agent and, if there are certificates, with that of the last one."""
        world, names = self.deployment.options.world, self.names
        order = Order(
            what=what,
            endpoint=self.deployment.endpoint,
            run=world.run,
            certs=self.deployment.certs,
            name=names[-1] if self.deployment.certs and certificate else "",
            prefix=world.domain.agent_prefix,
            channels=self._channels,
            seconds=seconds,
        )
        command = [
            sys.executable,
            "-P",
            "-m",
            "marl_sched.comms.chaos.intruder",
            wire.msgspec.json.encode(order).decode(),
        ]
        intruder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        said: list[str] = []
        self.intruders[intruder] = said
        threading.Thread(target=lambda: said.extend(intruder.stdout or ()), daemon=True).start()
        self.until(lambda: bool(said) or intruder.poll() is not None, f"meet an intruder that is to {what}")
        self.faults[what] += bool(said)
        return intruder

    def suffer(self, what: str, seconds: float, *, certificate: bool = True) -> None:
        """Let an intruder do its worst, and count what it did."""
        intruder = self.intrude(what, seconds, certificate=certificate)
        self.until(lambda: intruder.poll() is not None, f"outlast an intruder that was to {what}")
        said = self.intruders[intruder]
        self.until(lambda: len(said) > 1, f"hear what an intruder did that was to {what}", 5.0)
        self.faults.update({f"{what} {kind}": n for kind, n in json.loads(said[1]).items()})

    def end(self) -> RunReport:
        """Interrupt the run; its report."""
        self.deployment.look()
        self.deployment.phase = "over"
        self.deployment.signal(WORLD, signal.SIGTERM)
        report = self.deployment.wait()
        self.faults.update(report.injected)
        if self.link is not None:
            self.faults.update(self.link.hit)
        return report

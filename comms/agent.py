"""An agent process: it hears what its view lets it hear, keeps its local state, and decides when it is its turn.

The protocol (`marl_sched.comms.protocol.agent_protocol`) decides what happens; this file carries it out.

By hand: `python -m marl_sched.comms.agent '{"agent": 3, "policy": "random"}'`, or `marl-sched agent`.
"""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from marl_sched.comms.agent_options import AgentOptions
from marl_sched.comms.logs import set_up_logs
from marl_sched.comms.metrics.throttle import ThrottledLog
from marl_sched.comms.mind import PolicyMind
from marl_sched.comms.process import interruptible, run_process
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.agent_protocol import AgentProtocol
from marl_sched.comms.protocol.rules import AgentRules
from marl_sched.comms.transport.base import Transport
from marl_sched.comms.transport.faulty import Faults, FaultyTransport
from marl_sched.errors import DeploymentError

log = logging.getLogger(__name__)


class Agent:
    """One agent of a run, driven by a clock and a network.

    Attributes:
        protocol: what decides.
    """

    def __init__(
        self,
        options: AgentOptions,
        transport: Transport,
        *,
        rules: AgentRules | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.options, self.transport, self._clock = options, transport, clock
        self.mind = PolicyMind(options)
        self.protocol = AgentProtocol(
            rules or AgentRules(join=options.join_timeout, silence=max(4.0, 3 * options.lease)),
            run=options.run,
            agent=options.agent,
            policy=options.policy,
            identity=f"{time.time_ns():x}-{os.getpid():x}",
            mind=self.mind,
            now=clock(),
        )
        self._warnings = ThrottledLog(log)

    def run(self) -> Counter[str]:
        """Decide until the run is over; counts of what was heard, decided and dropped.

        Raises DeploymentError when there is no world or it does not want this agent, InvalidOptionError when the
        agent does not exist or its policy needs more than an observation.
        """
        self.handle(ev.Reopened())
        event: ev.Event | None = None
        while self.protocol.ended is None:
            attentive = self.protocol.attentive or event is None
            event = self.transport.receive(max(self.protocol.wake_at - self._clock(), 0.0), attentive=attentive)
            self.handle(ev.Wake() if event is None else event)
        if self.protocol.ended.ending == ev.Ending.FAILED:
            raise DeploymentError(f"agent {self.options.agent}: {self.protocol.ended.reason}")
        return self.protocol.counts

    def handle(self, event: ev.Event) -> None:
        """Give the protocol an event and carry out what it says, and what that brings about."""
        for effect in self.protocol.handle(event, self._clock()):
            match effect:
                case ev.Put(key, message, control):
                    self.transport.put(key, wire.encode(message), control=control)
                case ev.Ask(question, key, asked):
                    self.transport.ask(question, key, b"" if asked is None else wire.encode(asked))
                case ev.Choose(turn):
                    self.handle(ev.Chosen(turn.sequence, *self.mind.choose(turn.noise)))
                case ev.Announce(key):
                    self.mind.rehearse()  # before the world counts on it
                    self.transport.announce(key)
                case ev.Reopen():
                    self.transport.reopen()
                    self.handle(ev.Reopened())
                case ev.Subscribe(key, quiet):
                    self.transport.subscribe(key, quiet=quiet)
                case ev.Unsubscribe(key):
                    self.transport.unsubscribe(key)
                case ev.Watch(key):
                    self.transport.watch(key)
                case ev.Withdraw(key):
                    self.transport.withdraw(key)
                case ev.Warn(kind, text):
                    self._warnings.warn(kind, text, self._clock())


def run(options: AgentOptions, progress: Any = None) -> Counter[str]:
    """Be one agent of a run until it is over; see Agent.run for what it raises. Signals end it with a goodbye."""
    from marl_sched.comms.security.refusals import log_warnings
    from marl_sched.comms.transport.zenoh_session import spoke

    os.environ.setdefault("OMP_NUM_THREADS", "1")  # one decision is too small to share, and stays bit-equal
    set_up_logs(options.log_format, f"agent-{options.agent}", options.run)
    log_warnings()
    identity = options.identity()
    transport: Transport = spoke(options.run, options.connect, options.join_timeout, options.lease, identity=identity)
    if options.faults:
        transport = FaultyTransport(transport, Faults.of(options.faults), options.agent + 1)
    try:
        with interruptible(transport):
            return Agent(options, transport).run()
    finally:
        transport.close()


if __name__ == "__main__":
    run_process(AgentOptions, run)

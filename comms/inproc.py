"""A network in memory, so that a whole deployment runs in one process: world and agents as threads, or step by step.

`Bus` connects nodes as Zenoh would: keys with wildcards, liveliness tokens, queries. `play` runs a world and its
agents on one and gives the report that `deploy` would.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from marl_sched.comms.agent_options import AgentOptions
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.protocol.events import Answered, Event, Queried, Received, TokenAppeared, TokenVanished
from marl_sched.comms.protocol.rules import AgentRules
from marl_sched.comms.transport.inbox import Inbox

if TYPE_CHECKING:
    from marl_sched.comms.agent import Agent
    from marl_sched.comms.decision_log import CommitLog
    from marl_sched.comms.metrics.report import RunReport
    from marl_sched.comms.plant import Plant

Deliver = Callable[[str, bytes], int]


class Bus:
    """Connects nodes. `deliver(key, payload)` says how many copies of a message arrive; by default one.

    Attributes:
        log: everything that was put, in order, if `keep_log`.
        tokens: the liveliness tokens that stand, key -> the node that holds it.
    """

    def __init__(self, deliver: Deliver | None = None, *, keep_log: bool = False) -> None:
        self.deliver = deliver
        self.nodes: list[Node] = []
        self.tokens: dict[str, Node] = {}
        self.log: list[tuple[str, bytes]] = []
        self.keep_log = keep_log
        self.lock = threading.RLock()
        self.queries: dict[int, tuple[Node, int]] = {}
        self._last_query = 0

    def node(self) -> Node:
        """One more session."""
        with self.lock:
            self.nodes.append(Node(self))
            return self.nodes[-1]

    def put(self, sender: Node, key: str, payload: bytes) -> None:
        """Deliver a message to all nodes but its sender that hear its key."""
        with self.lock:
            if self.keep_log:
                self.log.append((key, payload))
            for _ in range(1 if self.deliver is None else self.deliver(key, payload)):
                for node in self.nodes:
                    if node is not sender and node.hears(key):
                        node.inbox.put(key, Received(key, payload), quiet=key in node.quiet)

    def set_token(self, holder: Node, key: str, *, stands: bool) -> None:
        """Let a token stand or go, and tell those who watch it."""
        with self.lock:
            if stands:
                self.tokens[key] = holder
            elif self.tokens.pop(key, None) is None:
                return
            for node in self.nodes:
                if node.watches(key):
                    node.inbox.put(("token", key), TokenAppeared(key) if stands else TokenVanished(key))

    def ask(self, asker: Node, question: int, key: str, payload: bytes) -> None:
        """Give a query to the first node that serves its key."""
        with self.lock:
            for node in self.nodes:
                if any(fnmatchcase(key, pattern) for pattern in node.served):
                    self._last_query += 1
                    self.queries[self._last_query] = (asker, question)
                    node.inbox.put(("query", self._last_query), Queried(key, payload, self._last_query))
                    return


class Node:
    """A Transport on a Bus."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.inbox = bus, Inbox()
        self.dropped: Counter[str] = self.inbox.dropped
        self.subscribed: set[str] = set()
        self.quiet: set[str] = set()  # those of them that wake nobody
        self.wild: set[str] = set()  # those of them that hold wildcards
        self.watched: set[str] = set()
        self.served: set[str] = set()
        self.on_put: Callable[[str, bytes], None] | None = None  # may raise, to play a process that dies

    def hears(self, key: str) -> bool:
        """Whether a message by that key arrives here."""
        return key in self.subscribed or any(fnmatchcase(key, pattern) for pattern in self.wild)

    def watches(self, key: str) -> bool:
        """Whether this node is told of a token."""
        return any(fnmatchcase(key, pattern) for pattern in self.watched)

    def put(self, key: str, payload: bytes, *, control: bool = False) -> None:
        """See Transport.put."""
        if self.on_put is not None:
            self.on_put(key, payload)
        self.bus.put(self, key, payload)

    def receive(self, timeout: float, *, attentive: bool = True) -> Event | None:
        """See Transport.receive."""
        return self.inbox.get(timeout, attentive=attentive)

    def inject(self, event: Event) -> None:
        """See Transport.inject."""
        self.inbox.inject(event)

    def subscribe(self, key: str, *, quiet: bool = False) -> None:
        """See Transport.subscribe."""
        with self.bus.lock:
            self.subscribed.add(key)
            if quiet:
                self.quiet.add(key)
            if "*" in key:
                self.wild.add(key)

    def unsubscribe(self, key: str) -> None:
        """See Transport.unsubscribe."""
        with self.bus.lock:
            self.subscribed.discard(key)
            self.quiet.discard(key)
            self.wild.discard(key)

    def watch(self, key: str) -> None:
        """See Transport.watch."""
        with self.bus.lock:
            self.watched.add(key)
            for token in self.bus.tokens:
                if fnmatchcase(token, key):
                    self.inbox.put(("token", token), TokenAppeared(token))

    def announce(self, key: str) -> None:
        """See Transport.announce."""
        self.bus.set_token(self, key, stands=True)

    def withdraw(self, key: str) -> None:
        """See Transport.withdraw."""
        self.bus.set_token(self, key, stands=False)

    def serve(self, key: str) -> None:
        """See Transport.serve."""
        with self.bus.lock:
            self.served.add(key)

    def reply(self, query: int, payload: bytes | None) -> None:
        """See Transport.reply."""
        with self.bus.lock:
            asker, question = self.bus.queries.pop(query)
            place: Hashable = ("answer", question)
            if payload is not None:
                asker.inbox.put(place, Answered(question, payload))

    def ask(self, question: int, key: str, payload: bytes) -> None:
        """See Transport.ask."""
        self.bus.ask(self, question, key, payload)

    def reopen(self) -> None:
        """See Transport.reopen."""
        with self.bus.lock:
            self._disconnect()
            self.bus.nodes.append(self)

    def close(self) -> None:
        """See Transport.close."""
        with self.bus.lock:
            self._disconnect()

    def _disconnect(self) -> None:
        for token in [token for token, holder in self.bus.tokens.items() if holder is self]:
            self.bus.set_token(self, token, stands=False)
        for keys in (self.subscribed, self.quiet, self.wild, self.watched, self.served):
            keys.clear()
        if self in self.bus.nodes:
            self.bus.nodes.remove(self)


class Threads:
    """A world and its agents as threads of this process on a Bus.

    Attributes:
        world: created at once; `nodes` and `agents` are the agents' sessions and, once they run, the agents.
        errors: what agents raised.
    """

    def __init__(
        self,
        options: WorldOptions,
        policies: Sequence[str],
        bus: Bus | None = None,
        *,
        agent_rules: AgentRules | None = None,
        commits: CommitLog | None = None,
        plant: Plant | None = None,
    ) -> None:
        from marl_sched.comms.world import World

        self.options, self.policies, self.bus = options, list(policies), bus or Bus()
        self.world = World(options, self.bus.node(), commits=commits, plant=plant)
        self.nodes = [self.bus.node() for _ in self.policies]
        self.agents: list[Agent | None] = [None] * len(self.policies)
        self.errors: list[BaseException] = []
        self._rules = agent_rules

    def play(self) -> RunReport:
        """Play the run to its end; the world's report."""
        threads = [threading.Thread(target=self.run_agent, args=(i,), daemon=True) for i in range(len(self.policies))]
        for thread in threads:
            thread.start()
        try:
            return self.world.run()
        finally:
            for thread in threads:
                thread.join(timeout=10)

    def run_agent(self, index: int) -> None:
        """Be one agent until the run is over."""
        from marl_sched.comms.agent import Agent

        try:
            options = AgentOptions(agent=index, policy=self.policies[index], run=self.options.run, join_timeout=20.0)
            agent = self.agents[index] = Agent(options, self.nodes[index], rules=self._rules)
            agent.run()
        except BaseException as error:  # a thread has nobody to raise to; `errors` has them
            self.errors.append(error)
        finally:
            self.nodes[index].close()


def play(options: WorldOptions, policies: Sequence[str], bus: Bus | None = None) -> RunReport:
    """Play a run in this process, an agent with each policy; the report that `deploy` would give.

    Raises what an agent raised, if one did.
    """
    threads = Threads(options, policies, bus)
    report = threads.play()
    if threads.errors:
        raise threads.errors[0]
    return report

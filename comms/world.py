"""The world process: the plant. It owns the simulator, tells what happens, grants turns and applies decisions.

Time is lock-step. Within a moment the free agents decide in turn order; the world says the new state of every
channel that changed, gives the acting agent its turn, and waits for the decision no longer than the deadline. It
imports no policy and no torch.

By hand: `python -m marl_sched.comms.world '{"seed": 1, "hours": 48}'`, or `marl-sched world`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import numpy as np

from marl_sched.comms import messages as wire
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.process import run_process
from marl_sched.comms.report import ABSENT, CONFLICT, DECIDED, GONE, ILLEGAL, JOINED, LATE, SILENT, Books, build
from marl_sched.comms.roster import Roster
from marl_sched.comms.session import Event, Transport, hub, settle_port
from marl_sched.errors import DeploymentError, InvalidMessageError
from marl_sched.files import write_json
from marl_sched.graph import ACTION_MASK, VISIBLE_SHARE

log = logging.getLogger(__name__)
RESEND = 0.1  # seconds until a turn is sent again
FAREWELL = 2.0  # seconds in which agents may leave at the end
IDLE = 0
Progress = Callable[[str, int, int], None]  # (phase, simulated time, horizon)


class World:
    """One run, from the first hello to the report."""

    def __init__(self, options: WorldOptions, transport: Transport, progress: Progress | None = None) -> None:
        self.options, self.transport = options, transport
        self.domain, self.telemetry = options.domain(), options.telemetry()
        self.simulator = options.simulator()
        self.books = Books()
        self.roster = Roster(int(self.simulator.n_agents[0]), options.patience)
        self.phase: wire.Phase = "gathering"
        self._keys = wire.AgentKeys(self.domain.agent_prefix)
        self._frame = self.telemetry.frame(self.simulator)
        self._channels = [self.telemetry.local_state(self._frame, a).channels for a in range(len(self.roster.seats))]
        self._news: dict[str, wire.News] = {}
        self._progress = progress or (lambda phase, moment, horizon: None)
        self._observation = self.simulator.new_observation()

    @property
    def tick(self) -> int:
        """Simulated time."""
        return int(self.simulator.time[0])

    def run(self) -> dict[str, object]:
        """Gather the agents, play the episode, say goodbye; the report."""
        self._open()
        self._gather()
        started = time.monotonic()
        self.phase = "running"
        told = -1
        while not self.simulator.over[0]:
            self._say()
            if self.tick != told:
                told = self.tick
                self._put(wire.CLOCK, wire.Clock(tick=told, phase=self.phase))
                self._progress(self.phase, told, self._horizon)
            self._turn(int(self.simulator.acting[0]))
        seconds = time.monotonic() - started
        self._part()
        return build(self.options, self.simulator, self.roster, self.books, seconds)

    @property
    def _horizon(self) -> int:
        return self.options.hours or self.domain.default_horizon

    def _open(self) -> None:
        """Be there to be found."""
        self._say()
        for key in (self._keys.hello("*"), self._keys.decision("*")):
            self.transport.subscribe(key)
        self.transport.watch(self._keys.alive("*", "*"))
        for key in (wire.FRAME, wire.SNAPSHOT):
            self.transport.serve(key)
        self.transport.announce(wire.WORLD_ALIVE)
        self._progress(self.phase, 0, self._horizon)

    def _gather(self) -> None:
        """Wait for all agents; DeploymentError names those who are missing when the time is up."""
        end = time.monotonic() + self.options.ready_timeout
        while missing := self.roster.missing():
            event = self.transport.receive(end - time.monotonic())
            if event is not None:
                self._handle(event)
            elif time.monotonic() >= end:
                names = ", ".join(self.domain.agent_name(agent) for agent in missing)
                raise DeploymentError(f"not there within {self.options.ready_timeout:g} s: {names}")

    def _say(self) -> None:
        """Send every channel whose state changed."""
        for channel, payload in self.telemetry.messages(self.simulator).items():
            last = self._news.get(channel)
            if last is None or last.payload != payload:
                news = wire.News(sequence=last.sequence + 1 if last else 1, payload=payload)
                self._news[channel] = news
                self._put(channel, news)

    def _turn(self, agent: int) -> None:
        """Ask one agent, apply its decision, and write it down."""
        asked = time.monotonic()
        observation = self.simulator.observe(np.array([agent]), self._observation)
        target, outcome = self._ask(agent)
        tick, waited = self.tick, time.monotonic() - asked
        if outcome == DECIDED:
            self.books.latencies.append(waited)
        if target >= self.simulator.max_actions or not observation[ACTION_MASK][0, target]:
            outcome = ILLEGAL
            self.books.counts["illegal"] += 1
        self.simulator.step(np.array([IDLE if outcome == ILLEGAL else target]))
        if self.simulator.conflict[0]:
            outcome = CONFLICT
            self.books.counts["conflicts"] += 1
        self.books.shares.append(float(observation[VISIBLE_SHARE][0]))
        self.books.rewards.append(float(self.simulator.reward[0]))
        self.books.decisions.append(
            {
                self.telemetry.time_unit: tick,
                "agent": self.domain.agent_name(agent),
                self.simulator.graph.decision_of: target,
                "outcome": outcome,
            }
        )

    def _ask(self, agent: int) -> tuple[int, str]:
        """(target, outcome): the agent's decision, or target 0 if it is late or not there."""
        while (event := self.transport.receive(0.0)) is not None:
            self._note_stale(self._handle(event))
        seat = self.roster.seats[agent]
        seat.turns += 1
        if not seat.incarnation:
            return IDLE, ABSENT
        turn = wire.Turn(
            tick=self.tick,
            agent=agent,
            incarnation=seat.incarnation,
            sequence=seat.turns,
            noise=float(self.simulator.policy_noise(np.array([agent]))[0]),
            needs={channel: self._news[channel].sequence for channel in self._channels[agent]},
        )
        start = time.monotonic()
        deadline, resend = start + self.options.deadline, start
        while seat.incarnation == turn.incarnation:
            now = time.monotonic()
            if now >= deadline:
                self._note_late(agent, now - start)
                return IDLE, LATE
            if now >= resend:
                self._put(self._keys.turn(agent), turn)
                resend = now + RESEND
            event = self.transport.receive(min(deadline, resend) - now)
            decision = self._handle(event, now - start) if event is not None else None
            if decision is not None and decision.answers(turn):
                self.roster.answered(agent)
                return decision.target, DECIDED
            self._note_stale(decision)
        self.roster.miss(agent, time.monotonic() - start)  # it went with its turn open
        return IDLE, ABSENT

    def _note_stale(self, decision: wire.Decision | None) -> None:
        if decision is not None:
            self.books.counts["stale"] += 1

    def _note_late(self, agent: int, waited: float) -> None:
        self.books.counts["missed_deadlines"] += 1
        self._event(agent, LATE, waited)
        if self.roster.miss(agent, waited):
            seat = self.roster.seats[agent]
            self.roster.bury(agent, seat.incarnation)
            self._event(agent, SILENT, seat.waited)

    def _handle(self, event: Event, waited: float = 0.0) -> wire.Decision | None:
        """Take in an event; a decision is handed back, everything else is dealt with.

        `waited` is for how many seconds a turn has been open.
        """
        try:
            if event.kind == "query":
                self._answer(event)
            elif event.kind == "message":
                return self._hear(event)
            else:
                self._note_life(event, waited)
        except InvalidMessageError as error:
            self.books.counts["unparsed"] += 1
            log.warning("dropped a message: %s", error)
        return None

    def _hear(self, event: Event) -> wire.Decision | None:
        self.books.note_heard(event.key, event.payload)
        agent, leaf, _ = self._keys.parse(event.key)
        said: wire.Decision | wire.Hello
        if leaf == "decision":
            said = wire.decode(event.payload, wire.Decision)
        else:
            said = wire.decode(event.payload, wire.Hello)
        if said.agent != agent:
            raise InvalidMessageError(f"{event.key}: speaks for agent {said.agent}")
        if isinstance(said, wire.Decision):
            return said
        self._greet(said)
        return None

    def _note_life(self, event: Event, waited: float) -> None:
        """A liveliness token came or went."""
        agent, _, incarnation = self._keys.parse(event.key)
        if not self._seated(agent):
            return
        if event.kind == "gone" and self.roster.bury(agent, incarnation):
            self._event(agent, GONE, self.roster.seats[agent].waited + waited)
        elif event.kind == "alive" and incarnation in self.roster.seats[agent].fenced:
            self._fence(agent, incarnation, "this incarnation has been declared dead")

    def _seated(self, agent: int) -> bool:
        return agent < len(self.roster.seats)

    def _greet(self, hello: wire.Hello) -> None:
        known = self._seated(hello.agent) and self.roster.seats[hello.agent].incarnation == hello.incarnation
        refusal = self.roster.admit(hello.agent, hello.incarnation, hello.policy)
        if refusal:
            self._fence(hello.agent, hello.incarnation, refusal)
            return
        if not known:
            self._event(hello.agent, JOINED)
        self._put(self._keys.turn(hello.agent), wire.Welcome(agent=hello.agent, incarnation=hello.incarnation))

    def _fence(self, agent: int, incarnation: str, reason: str) -> None:
        self.books.counts["fenced"] += 1
        self._put(self._keys.turn(agent), wire.Fenced(agent=agent, incarnation=incarnation, reason=reason))

    def _answer(self, event: Event) -> None:
        """Tell the frame to everybody, and to an agent the state of the channels that it may hear."""
        if event.key == wire.FRAME:
            answer: wire.Message = wire.Frame(env=self.domain.name, agents=len(self.roster.seats), problem=self._frame)
        else:
            agent = wire.decode(event.payload, wire.SnapshotRequest).agent
            channels = self._channels[agent] if self._seated(agent) else ()
            clock = wire.Clock(tick=self.tick, phase=self.phase)
            answer = wire.Snapshot(clock=clock, channels={channel: self._news[channel] for channel in channels})
        payload = wire.encode(answer)
        self.books.note_sent(event.key, payload)
        self.transport.reply(event, payload)

    def _part(self) -> None:
        """Say that it is over until all agents have left, or for FAREWELL seconds."""
        self.phase = "over"
        self._progress(self.phase, self.tick, self._horizon)
        events, end = len(self.books.events), time.monotonic() + FAREWELL
        while len(self.roster.missing()) < len(self.roster.seats) and time.monotonic() < end:
            self._put(wire.CLOCK, wire.Clock(tick=self.tick, phase=self.phase))
            event = self.transport.receive(RESEND)
            while event is not None:
                self._handle(event)
                event = self.transport.receive(0.0)
        del self.books.events[events:]  # leaving now is no mishap

    def _event(self, agent: int, event: str, waited: float = 0.0) -> None:
        self.books.note_event(self.telemetry.time_unit, self.tick, self.domain.agent_name(agent), event, waited)
        log.info("%s %d: %s %s", self.telemetry.time_unit, self.tick, self.domain.agent_name(agent), event)

    def _put(self, key: str, message: wire.Message) -> None:
        payload = wire.encode(message)
        self.books.note_sent(key, payload)
        self.transport.put(key, payload)


def serve(options: WorldOptions, progress: Progress | None = None) -> dict[str, object]:
    """Be the world of one run; the report, which is also written to `options.report` if that is set.

    Raises DeploymentError if the endpoint is in use or an agent is missing at the start, and the typed errors
    of a problem that does not exist.
    """
    with hub(options.run, settle_port(options.listen)) as link:
        report = World(options, link, progress).run()
    if options.report:
        write_json(options.report, report)
    return report


if __name__ == "__main__":
    run_process(WorldOptions, serve)

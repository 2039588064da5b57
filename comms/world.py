"""The world process: the plant, and the protocol's world driven by a clock and a network.

The protocol (`marl_sched.comms.protocol.world_protocol`) decides what happens; this file carries it out. It imports
no policy and no torch.

By hand: `marl-sched world`, or `python -m marl_sched.comms.world OPTIONS`, which are `WorldOptions.as_json` as JSON.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from marl_sched.comms.decision_log import (
    Accepted,
    CommitLog,
    FileLog,
    Header,
    MemoryLog,
    Resumed,
    Step,
    play_again,
    team_orders,
)
from marl_sched.comms.logs import set_up_logs
from marl_sched.comms.metrics.report import RunReport, build_report
from marl_sched.comms.metrics.run_metrics import RunMetrics
from marl_sched.comms.metrics.throttle import ThrottledLog
from marl_sched.comms.observation import Observation
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import Plant
from marl_sched.comms.process import interruptible, run_process
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.world_protocol import WorldProtocol
from marl_sched.comms.security.identity import Identity
from marl_sched.comms.transport.base import Transport
from marl_sched.comms.transport.faulty import Faults, FaultyTransport
from marl_sched.errors import DeploymentError, InvalidMessageError
from marl_sched.files import write_json

log = logging.getLogger(__name__)
TELL = 0.05  # seconds between two words of progress, unless the phase changes
Progress = Callable[[str, int, int], None]  # (phase, how much of the horizon has passed, horizon)


class Refusals:
    """What the network refused, counted by the thread that reads of it."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._warnings = ThrottledLog(log)

    def count(self, kind: str, amount: int) -> None:
        """`denied` messages, or `refused` connections."""
        self.counts[kind] += amount
        self._warnings.warn(kind, f"{self.counts[kind]} {kind} in all", time.monotonic())

    def tell(self, line: str) -> None:
        """Another warning of the network."""
        self._warnings.warn("network", line, time.monotonic())


class World:
    """One life of a run's world, from the first hello to the report.

    Attributes:
        protocol: what decides.
        metrics: what is counted.
    """

    def __init__(
        self,
        options: WorldOptions,
        transport: Transport,
        *,
        plant: Plant | None = None,
        commits: CommitLog | None = None,
        progress: Progress | None = None,
        refused: Refusals | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`plant`: the domain's simulator unless given, at its start or, with a log, where that ends."""
        self.options, self.transport, self.metrics, self._clock = options, transport, RunMetrics(), clock
        self.domain, self.telemetry = options.domain, options.telemetry()
        self.plant: Plant = plant or options.plant()
        self.epoch = f"{time.time_ns():x}-{os.getpid():x}"
        self.commits = commits if commits is not None else MemoryLog()
        resumed = isinstance(self.commits, FileLog) and self.commits.resumed
        earlier = self.commits.played() if isinstance(self.commits, FileLog) else []
        if isinstance(self.commits, FileLog) and resumed:
            if self.plant.simulated:
                play_again(self.plant, earlier, self.commits.path)
            self.commits.append(Resumed(epoch=self.epoch))
        self.protocol = WorldProtocol(
            options.rules(),
            run=options.run,
            epoch=self.epoch,
            env=self.domain.name,
            prefix=self.domain.agent_prefix,
            frame=self.plant.frame,
            channels=self.plant.channels,
            now=clock(),
            resumed=resumed,
            orders=team_orders(earlier),
        )
        self._keys = keys.AgentKeys(self.domain.agent_prefix)
        self._warnings = ThrottledLog(log)
        self._progress = progress or (lambda phase, tick, horizon: None)
        self._told: tuple[str, int] = ("", -1)
        self._tell_at = -math.inf
        self._chosen: dict[int, ev.Choice] = {}  # by agents whose turn has not come yet
        self._tick = self._passed = 0
        self._applied = False  # choices, and the plant has not been asked yet where it stands now
        self._refused = refused or Refusals()
        self._observation = Observation(self.domain.agent_prefix, self.telemetry.time_unit, options.problem.horizon)

    def run(self) -> RunReport:
        """Gather the agents, play the episode, say goodbye; the report, whatever the end.

        DeploymentError, with the report as its `report`, if not all agents came in time. An error of the plant is
        raised when the report is written.
        """
        started = self._clock()
        try:
            self._open()
            while self.protocol.ended is None:
                self._turn_once()
        except BaseException as error:
            self._report(ev.End(ev.Ending.FAILED, f"{type(error).__name__}: {error}"[:400]), self._clock() - started)
            raise
        report = self._report(self.protocol.ended, self._clock() - started)
        if self.protocol.ended.ending == ev.Ending.NOT_GATHERED:
            raise DeploymentError(self.protocol.ended.reason)
        return report

    def _open(self) -> None:
        """Be there to be found."""
        self._advance()
        for key in (self._keys.hello("*"), self._keys.decision("*")):
            self.transport.subscribe(key)
        self.transport.watch(self._keys.alive("*", "*"))
        for key in (keys.FRAME, keys.snapshot("*"), keys.COMMAND):
            self.transport.serve(key)
        self.transport.announce(keys.WORLD_ALIVE)
        self._tell_progress()

    def _turn_once(self) -> None:
        """Wait for the next event, or until the protocol wants to be woken, and carry out what it says.

        When choices were applied the plant goes on after one event that waits already, so that a world whose time is
        always overdue hears what is said all the same.
        """
        applied, self._applied = self._applied, False
        event = self.transport.receive(0.0 if applied else max(self.protocol.wake_at - self._clock(), 0.0))
        if event is not None or not applied:
            self._take(event)
        if applied:
            self._advance()
        self._tell_progress()

    def _take(self, event: ev.Event | None) -> None:
        if isinstance(event, ev.Received):
            self._count_heard(event)
        effects = self.protocol.handle(ev.Wake() if event is None else event, self._clock())
        self._perform(effects)
        if isinstance(event, ev.Queried) and not any(isinstance(effect, ev.Reply | ev.Order) for effect in effects):
            self.transport.reply(event.query, None)

    def _count_heard(self, event: ev.Received) -> None:
        try:
            kind = f"{self.domain.agent_prefix}/{self._keys.parse(event.key)[1]}"
        except InvalidMessageError:
            kind = "other"
        self.metrics.note_heard(kind, event.payload)

    def _perform(self, effects: list[ev.Effect]) -> None:
        for effect in effects:
            match effect:
                case ev.Put(key, message, control):
                    payload = wire.encode(message)
                    self.metrics.note_sent(key, payload)
                    self.transport.put(key, payload, control=control)
                    if key == keys.CLOCK:
                        self._tell_observers()
                case ev.Reply(query, message):
                    payload = wire.encode(message)
                    self.metrics.note_sent("world/answer", payload)
                    self.transport.reply(query, payload)
                case ev.Order(query, order):
                    reason = self.plant.order(order)
                    if reason is None:
                        self.commits.append(Accepted(order=order))
                    answer = ev.Ordered(query, order.request, reason)
                    self._perform(self.protocol.handle(answer, self._clock()))
                case ev.Keep(order):
                    self.commits.append(Accepted(order=order))
                case ev.Apply(choices):
                    self._apply(choices)
                case ev.Note():
                    self._note(effect)
                case ev.Count(kind, amount):
                    self.metrics.counts[kind] += amount
                case ev.Warn(kind, text):
                    self._observation.last_error = text
                    self._warnings.warn(kind, text, self._clock())

    def _tell_observers(self) -> None:
        counts = self.metrics.counts + self.transport.dropped + self._refused.counts
        said = self._observation.message(
            self.options.run,
            self.epoch,
            tick=self._tick,
            phase=self.protocol.phase,
            slots=self.protocol.members.slots,
            objectives=self.plant.objectives(),
            counts=counts,
            now=self._clock(),
        )
        self.transport.put(keys.OBSERVED, wire.encode(said))

    def _apply(self, choices: tuple[ev.Choice, ...]) -> None:
        self._chosen.update((choice.agent, choice) for choice in choices)
        commits = self.plant.apply(choices)
        if commits:
            sources = [self._chosen.pop(commit.agent).source for commit in commits]
            self.commits.append(Step(commits=commits, sources=sources))
            self._observation.note(commits)
            self.metrics.note_applied(self._clock())
        for choice in choices:
            if choice.outcome == ev.Outcome.DECIDED:
                self.metrics.latency.add(choice.latency)
        for commit in commits:
            self.metrics.counts["conflicts"] += commit.outcome == ev.Outcome.CONFLICT
            self.metrics.counts["illegal"] += commit.outcome == ev.Outcome.ILLEGAL
        self._applied = True

    def _advance(self) -> None:
        state = self.plant.state()
        self._tick, self._passed = state.tick, state.progress
        self._perform(self.protocol.handle(state, self._clock()))

    def _note(self, note: ev.Note) -> None:
        if note.event == "running":
            self.metrics.standstill_s += note.waited
        elif note.event == "slept":
            self.metrics.slept_s += note.waited
        name = "world" if note.agent < 0 else self.domain.agent_name(note.agent)
        self.metrics.note_event(self._tick, name, note.event, note.waited)
        if note.agent >= 0 and self.protocol.phase != "gathering":
            self._tell_observers()
        log.info("%s %d: %s %s", self.telemetry.time_unit, self._tick, name, note.event)

    def _tell_progress(self) -> None:
        now, told = self._clock(), (self.protocol.phase, self._passed)
        if told[0] != self._told[0] or (told != self._told and now >= self._tell_at):
            self._told, self._tell_at = told, now + TELL
            self._progress(*told, self.options.problem.horizon)

    def _report(self, ending: ev.End, seconds: float) -> RunReport:
        self.metrics.counts.update(self.transport.dropped)
        self.metrics.counts.update(self._refused.counts)
        if isinstance(self.transport, FaultyTransport):
            self.metrics.injected.update(self.transport.injected)
        report = build_report(
            self.options,
            ending=ending,
            summary=self.plant.summary(),
            commits=self.commits.commits(),
            slots=self.protocol.members.slots,
            metrics=self.metrics,
            seconds=seconds,
        )
        if self.options.report:
            write_json(self.options.report, report.as_json())
        return report


def serve(options: WorldOptions, progress: Progress | None = None) -> RunReport:
    """Be the world of one run; the report, which is also written to `options.report` if that is set.

    It goes on from `options.log` if that holds commits. SIGINT, SIGTERM and SIGHUP end the run with a report. Raises
    DeploymentError if the endpoint is in use or an agent is missing at the start, InvalidFileError for the log of
    another run, and the typed errors of a problem that does not exist.
    """
    from marl_sched.comms.security.refusals import counted_refusals

    set_up_logs(options.log_format, "world", options.run)
    commits: CommitLog = MemoryLog()
    if options.log:
        commits = FileLog(Path(options.log), Header.of(options), options.sync)
    identity, plant, refused = options.identity(), options.plant(), Refusals()
    with counted_refusals(refused.count, refused.tell):
        transport = _session(options, identity, plant)
        if options.faults:
            transport = FaultyTransport(transport, Faults.of(options.faults), 0)
        try:
            world = World(options, transport, plant=plant, commits=commits, progress=progress, refused=refused)
            with interruptible(transport):
                return world.run()
        finally:
            transport.close()


def _session(options: WorldOptions, identity: Identity | None, plant: Plant) -> Transport:
    """The hub that agents connect to, or a session with one of the routers that they connect to."""
    from marl_sched.comms.transport.endpoints import settle_port
    from marl_sched.comms.transport.zenoh_session import hub, spoke

    if options.routers:
        return spoke(options.run, ",".join(options.routers), options.ready_timeout, options.lease, identity=identity)
    return hub(
        options.run,
        settle_port(options.listen),
        options.domain.agent_prefix,
        options.lease,
        identity=identity,
        channels=plant.channels,
    )


def exit_code_of(report: RunReport) -> int:
    """What a process ends with after a run."""
    return report.ending.exit_code


if __name__ == "__main__":
    run_process(WorldOptions, serve, exit_code_of)

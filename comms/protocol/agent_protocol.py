"""What an agent does on every event: find the world, join, keep up, decide when asked. No clock, thread or socket."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from typing import Protocol

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.question import Question
from marl_sched.comms.protocol.rules import AgentRules
from marl_sched.errors import InvalidMessageError

MAX_JUMP = 10_000  # sequence numbers that a channel can go on at once; more is asked about


class AgentState(StrEnum):
    """Where an agent stands."""

    SEEKING = "seeking"  # it has asked for the frame
    CATCHING_UP = "catching up"  # it has asked for the state of its channels
    JOINING = "joining"  # it says hello
    SERVING = "serving"  # it is welcome and decides when asked
    REOPENING = "reopening"  # its session is being closed and opened again
    ENDED = "ended"


class Mind(Protocol):
    """What an agent knows and how it sees the problem; deterministic, without transport."""

    def meet(self, frame: wire.Frame) -> tuple[str, Sequence[str]]:
        """Know nothing but the frame; the prefix of agents' names and the channels that this agent may hear."""

    def learn(self, channel: str, payload: bytes) -> None:
        """Take in a channel's state; InvalidMessageError, and no change, if it does not parse."""

    def forget(self) -> bool:
        """Begin another incarnation, with an empty memory; whether this mind has a memory at all."""


class AgentProtocol:
    """One agent of a run, from its first question to its goodbye; the first event is Reopened.

    Attributes:
        state: see AgentState.
        incarnation: the name of this life of the agent, "" before the first.
        subscriptions: the keys that it hears.
        counts: what it heard, decided and dropped; the world gets them with every beat.
        wake_at: when `handle(Wake(), now)` is due at the latest.
        ended: why it ended, None before.
    """

    def __init__(
        self, rules: AgentRules, *, run: str, agent: int, policy: str, identity: str, mind: Mind, now: float
    ) -> None:
        """`identity` is unique to this process; its incarnations are `<identity>-<count>`."""
        self.rules, self.state = rules, AgentState.REOPENING
        self.incarnation, self.counts = "", Counter[str]()
        self.ended: ev.End | None = None
        self.subscriptions: set[str] = set()
        self._run, self._agent, self._policy, self._identity, self._mind = run, agent, policy, identity, mind
        self._epoch, self._heartbeat, self._tick, self._keys = "", 0.5, 0, keys.AgentKeys("agent")
        self._versions: dict[str, int] = {}
        self._turn: wire.Turn | None = None  # the one to answer, once the local state is up to date
        self._choosing: wire.Turn | None = None
        self._sent: wire.Decision | None = None
        self._lives, self._question, self._hello_at = 0, Question(rules), math.inf
        self._join_by, self._refusal = now + rules.join, ""
        self._announced = ""
        self._heard_at = self._last = self.wake_at = now
        self._seek_at = -math.inf

    def handle(self, event: ev.Event, now: float) -> list[ev.Effect]:
        """What to do about an event. `now` never goes back. After the end nothing is done."""
        out: list[ev.Effect] = []
        if self.ended is not None:
            return out
        self._notice_sleep(now)
        match event:
            case ev.Reopened():
                self._reopened(now, out)
            case ev.Answered(question, payload) if question == self._question.number and self._question.key is not None:
                self._answered(payload, now, out)
            case ev.Received():
                self._hear(event, now, out)
            case ev.TokenAppeared(key) if key == keys.WORLD_ALIVE:
                if self.state == AgentState.SERVING and now - self._heard_at > self._heartbeat:
                    self._seek(now, out)  # back again, perhaps as another epoch
            case ev.Chosen():
                self._chosen(event, out)
            case ev.Interrupted(number):
                self._end(ev.End(ev.Ending.INTERRUPTED, f"signal {number}"), out)
        self._pass_time(now, out)
        self._last = now
        self.wake_at = self._next_wake()
        return out

    @property
    def attentive(self) -> bool:
        """Whether states matter now; if not, they may wait unread until the next turn or wake-up."""
        return self._turn is not None

    def _notice_sleep(self, now: float) -> None:
        slept = now - max(self._last, self.wake_at)
        if slept > self.rules.slept and self._choosing is None:
            self._heard_at, self._join_by = now, self._join_by + slept
            self.counts["slept"] += 1

    def _pass_time(self, now: float, out: list[ev.Effect]) -> None:
        if self.ended is not None:
            return
        if now >= self._join_by and self.state != AgentState.SERVING:
            why = self._refusal or f"no world of run {self._run!r} answered within {self.rules.join:g} s"
            self._end(ev.End(ev.Ending.FAILED, why), out)
            return
        if self.state != AgentState.REOPENING and now - self._heard_at >= self.rules.silence:
            self._reopen(now, out)
            return
        if (again := self._question.due(now)) is not None:
            out.append(again)
        if now >= self._hello_at:
            self._speak(now, out)

    def _next_wake(self) -> float:
        if self.ended is not None:
            return math.inf
        join_by = math.inf if self.state == AgentState.SERVING else self._join_by
        silent_at = math.inf if self.state == AgentState.REOPENING else self._heard_at + self.rules.silence
        return min(self._question.wake_at, self._hello_at, join_by, silent_at)

    def _speak(self, now: float, out: list[ev.Effect]) -> None:
        """Say hello until welcomed, then once a heartbeat that this agent lives."""
        said: wire.Message
        who = {"run": self._run, "epoch": self._epoch, "agent": self._agent, "incarnation": self.incarnation}
        if self.state == AgentState.SERVING:
            self._hello_at = now + self._heartbeat
            said = wire.Beat(**who, tick=self._tick, counts=dict(self.counts))  # type: ignore[arg-type]
        elif self.state == AgentState.JOINING:
            self._hello_at = now + self.rules.retry
            said = wire.Hello(**who, policy=self._policy)  # type: ignore[arg-type]
        else:
            self._hello_at = math.inf
            return
        out.append(ev.Put(self._keys.hello(self._agent), said, control=True))

    def _reopen(self, now: float, out: list[ev.Effect]) -> None:
        """The world lives, or this session is deaf: only a new session can tell."""
        self.counts["reopened"] += 1
        if self.state == AgentState.SERVING:
            self._join_by = now + self.rules.join
        self.state = AgentState.REOPENING
        self._question.close()
        self._hello_at = math.inf
        out.append(ev.Reopen())

    def _reopened(self, now: float, out: list[ev.Effect]) -> None:
        self.subscriptions, self._announced = set(), ""
        out.append(ev.Watch(keys.WORLD_ALIVE))
        self._seek(now, out)

    def _seek(self, now: float, out: list[ev.Effect]) -> None:
        """Ask which world there is; incarnation and local state stay if it is the same."""
        if self.state == AgentState.SERVING:
            self._join_by = now + self.rules.join
        self.state, self._heard_at, self._hello_at = AgentState.SEEKING, now, math.inf
        self._turn = None
        out.append(self._question.ask(keys.FRAME, None, now))

    def _answered(self, payload: bytes | None, now: float, out: list[ev.Effect]) -> None:
        if payload is None:
            self._question.retry(now)
            return
        key = self._question.key or ""
        kind: type[wire.Frame | wire.Snapshot] = wire.Frame if key == keys.FRAME else wire.Snapshot
        try:
            said: wire.Frame | wire.Snapshot = wire.decode(payload, kind)
            if said.run != self._run or (kind is wire.Snapshot and said.epoch != self._epoch):
                raise InvalidMessageError(f"{key}: the answer of another run or epoch")
        except InvalidMessageError as error:
            self._drop(key, error, out)
            version = wire.other_version(payload, kind)
            if version is not None:
                reason = f"the world speaks another version of the protocol: {version}, this is {wire.VERSION}"
                self._end(ev.End(ev.Ending.FAILED, reason), out)
                return
            self._question.retry(now)
            return
        self._question.close()
        self._heard_at = now
        if isinstance(said, wire.Frame):
            self._meet(said, now, out)
        else:
            self._caught_up(said, now, out)

    def _meet(self, frame: wire.Frame, now: float, out: list[ev.Effect]) -> None:
        """Listen to all that may be heard, then ask for the state; a new epoch begins with an empty mind."""
        if frame.epoch != self._epoch or not self.subscriptions:
            prefix, channels = self._mind.meet(frame)
            self._keys, self._heartbeat = keys.AgentKeys(prefix), frame.heartbeat
            self._versions, self._sent = {}, None
            wanted = {keys.CLOCK, self._keys.turn(self._agent), *channels}
            out += [ev.Unsubscribe(key) for key in sorted(self.subscriptions - wanted)]
            out += [ev.Subscribe(key, quiet=key in channels) for key in sorted(wanted - self.subscriptions)]
            self.subscriptions = wanted
            if frame.epoch != self._epoch:
                self._forget(out)
            self._epoch = frame.epoch
        self.state = AgentState.CATCHING_UP
        self._ask_snapshot(now, out)

    def _ask_snapshot(self, now: float, out: list[ev.Effect]) -> None:
        request = wire.SnapshotRequest(run=self._run, epoch=self._epoch, agent=self._agent)
        out.append(self._question.ask(keys.snapshot(self._agent), request, now))

    def _caught_up(self, snapshot: wire.Snapshot, now: float, out: list[ev.Effect]) -> None:
        self.counts["snapshots"] += 1
        self._tick = snapshot.tick
        for news in snapshot.channels:
            if news.channel in self.subscriptions and news.sequence > self._versions.get(news.channel, 0):
                self._learn(news, out)
        if snapshot.phase == "over":
            self._end(ev.End(ev.Ending.COMPLETE), out)
        elif self.state == AgentState.CATCHING_UP:
            self._join(now, out)
        else:
            self._decide(out)

    def _join(self, now: float, out: list[ev.Effect]) -> None:
        if not self.incarnation:
            self._lives += 1
            self.incarnation = f"{self._identity}-{self._lives}"
            if self._mind.forget() and self._tick > 0:
                self.counts["empty_memory"] += 1
                out.append(ev.Warn("memory", f"begins with an empty memory at {self._tick}"))
        token = self._keys.alive(self._agent, self.incarnation)
        if self._announced != token:
            self._announced = token
            out.append(ev.Announce(token))
        self.state, self._hello_at = AgentState.JOINING, now

    def _forget(self, out: list[ev.Effect]) -> None:
        """Give this incarnation up: the next one starts with nothing but its local state, its memory empty."""
        if self._announced:
            out.append(ev.Withdraw(self._announced))
        self._announced, self.incarnation, self._turn, self._sent = "", "", None, None

    def _read(self, event: ev.Received, out: list[ev.Effect]) -> wire.Message | None:
        """The message that came, None for one that cannot be read, which is counted."""
        try:
            if event.key == keys.CLOCK:
                return wire.decode(event.payload, wire.Clock)
            if event.key == self._keys.turn(self._agent):
                said: wire.ToAgent = wire.decode(event.payload, wire.Turn, wire.Welcome, wire.Fenced, wire.Refused)
                return said
            news = wire.decode(event.payload, wire.News)
            if news.channel != event.key:
                raise InvalidMessageError(f"the state of {news.channel[:60]} came by it")
            return news
        except InvalidMessageError as error:
            self._drop(event.key, error, out)
            return None

    def _hear(self, event: ev.Received, now: float, out: list[ev.Effect]) -> None:
        self.counts["heard"] += 1
        said = self._read(event, out)
        if said is None:
            return
        if said.run != self._run or said.epoch != self._epoch:
            self._hear_other_epoch(said, now, out)
            return
        if not isinstance(said, wire.News | wire.Refused):
            self._heard_at = now
        match said:
            case wire.News():
                self._hear_news(said, now, out)
            case wire.Refused():
                self._refused(said, out)
            case wire.Clock(tick=tick, phase=phase):
                self._tick = tick
                if phase == "over":
                    self._end(ev.End(ev.Ending.COMPLETE), out)
            case wire.Turn() | wire.Welcome() | wire.Fenced() if said.incarnation != self.incarnation:
                self.counts["other_incarnation"] += 1
            case wire.Fenced():
                self._fenced(said, now, out)
            case wire.Welcome():
                self._welcomed(now)
            case wire.Turn():
                self._welcomed(now)
                self._take(said, now, out)

    def _refused(self, said: wire.Refused, out: list[ev.Effect]) -> None:
        self.counts["refused"] += 1
        if self.state == AgentState.JOINING:
            self._end(ev.End(ev.Ending.FAILED, said.reason), out)

    def _hear_other_epoch(self, said: wire.Message, now: float, out: list[ev.Effect]) -> None:
        """Another world may have taken over; ask, at most once a second, instead of believing it."""
        self.counts["other_epoch"] += 1
        if said.run == self._run and self.state == AgentState.SERVING and now >= self._seek_at:
            self._seek_at = now + 1.0
            self._seek(now, out)

    def _hear_news(self, news: wire.News, now: float, out: list[ev.Effect]) -> None:
        last = self._versions.get(news.channel, 0)
        if news.sequence <= last or news.channel not in self.subscriptions:
            return
        if last and news.sequence > last + MAX_JUMP:
            self.counts["implausible"] += 1
            if self._question.key is None and now >= self._seek_at:
                self._seek_at = now + 1.0
                self._ask_snapshot(now, out)
            return
        self._learn(news, out)
        self._decide(out)

    def _learn(self, news: wire.News, out: list[ev.Effect]) -> None:
        try:
            self._mind.learn(news.channel, news.payload)
        except InvalidMessageError as error:
            self._drop(news.channel, error, out)
            return
        self._versions[news.channel] = news.sequence

    def _drop(self, key: str, error: InvalidMessageError, out: list[ev.Effect]) -> None:
        self.counts["unparsed"] += 1
        out.append(ev.Warn("unparsed", f"dropped a message on {key}: {error}"))

    def _welcomed(self, now: float) -> None:
        if self.state == AgentState.JOINING:
            self.state, self._hello_at, self._refusal = AgentState.SERVING, now + self._heartbeat, ""

    def _fenced(self, said: wire.Fenced, now: float, out: list[ev.Effect]) -> None:
        self.counts["fenced"] += 1
        if said.why in ("taken", "barred") and self.state == AgentState.JOINING:
            if said.why == "taken" and not self._refusal:
                self._join_by = min(self._join_by, now + self.rules.taken)
            self._refusal = said.reason
            return
        self._forget(out)
        self._seek(now, out)

    def _take(self, turn: wire.Turn, now: float, out: list[ev.Effect]) -> None:
        again = self._turn == turn
        self._turn, self._tick = turn, turn.tick
        if again and self._lacks(turn) and self._question.key is None:
            self._ask_snapshot(now, out)
        else:
            self._decide(out)

    def _lacks(self, turn: wire.Turn) -> bool:
        return any(self._versions.get(channel, 0) < sequence for channel, sequence in turn.needs.items())

    def _decide(self, out: list[ev.Effect]) -> None:
        """Answer the turn if there is one and the local state is exactly as up to date as it asks for."""
        turn = self._turn
        if turn is None or self._lacks(turn):
            return
        self._turn = None
        if any(self._versions[channel] > sequence for channel, sequence in turn.needs.items()):
            return  # the world has gone on without this decision
        if self._sent is not None and self._sent.answers(turn):
            out.append(ev.Put(self._keys.decision(self._agent), self._sent, control=True))
        elif self._choosing is None:
            self._choosing = turn
            out.append(ev.Choose(turn))

    def _chosen(self, chosen: ev.Chosen, out: list[ev.Effect]) -> None:
        turn, self._choosing = self._choosing, None
        if turn is None or turn.sequence != chosen.sequence or turn.incarnation != self.incarnation:
            return  # this life of the agent ended while its policy was thinking
        self._sent = wire.Decision(
            run=self._run,
            epoch=self._epoch,
            tick=turn.tick,
            agent=self._agent,
            incarnation=turn.incarnation,
            sequence=turn.sequence,
            action=chosen.action,
            remembered=chosen.remembered,
        )
        self.counts["decisions"] += 1
        out.append(ev.Put(self._keys.decision(self._agent), self._sent, control=True))

    def _end(self, ending: ev.End, out: list[ev.Effect]) -> None:
        if self.incarnation and ending.ending != ev.Ending.FAILED:
            goodbye = wire.Goodbye(
                run=self._run,
                epoch=self._epoch,
                agent=self._agent,
                incarnation=self.incarnation,
                counts=dict(self.counts),
            )
            out.append(ev.Put(self._keys.hello(self._agent), goodbye, control=True))
        self.state, self.ended = AgentState.ENDED, ending
        out.append(ending)

"""What the world does on every event: who is there, whose turn it is, when time goes on. No clock, thread or socket.

The states of a slot and their transitions are in `marl_sched.comms.membership.slots`; the run's own phases are
`gathering`, `running`, `standstill` (running, but time stands still) and `over`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from marl_sched.comms.membership.slots import Membership, Slot, SlotEvent, SlotState
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.answers import Answers
from marl_sched.comms.protocol.commands import Commands
from marl_sched.comms.protocol.reception import Reception
from marl_sched.comms.protocol.rules import WorldRules
from marl_sched.comms.protocol.timing import OpenTurn, RunTimes

IDLE = 0
RECOVERY = 3.0  # seconds that agents have to be heard again after the world itself has slept: lease and reconnection


class WorldProtocol:
    """One run of the world, from the first hello to the last goodbye.

    Attributes:
        phase: see the module's page.
        members: the slots.
        wake_at: when `handle(Wake(), now)` is due at the latest.
        ended: how the run ended, None before.
    """

    def __init__(
        self,
        rules: WorldRules,
        *,
        run: str,
        epoch: str,
        env: str,
        prefix: str,
        frame: bytes,
        channels: Sequence[Sequence[str]],
        now: float,
        resumed: bool = False,
        orders: Sequence[wire.Team] = (),
    ) -> None:
        """`channels` are those that each agent may hear; `resumed`: the run has been played in part before.

        `orders` about the team were taken by earlier epochs, in this order, and hold.
        """
        self.rules = rules
        self.phase: wire.Phase = "gathering"
        self.members = Membership(len(channels), rules.patience, rules.bar)
        self.ended: ev.End | None = None
        self._run, self._epoch, self._prefix = run, epoch, prefix
        self._keys, self._channels, self._resumed = keys.AgentKeys(prefix), channels, resumed
        self._news: dict[str, wire.News] = {}
        self._open: dict[int, OpenTurn] = {}  # in the order in which the plant asks
        self._choices: dict[int, ev.Choice] = {}
        self._tick = 0
        self._applying = self._over = False
        self._times, self._last = RunTimes(rules, ready_by=now + rules.ready, clock_at=now), now
        self._commands = Commands(self.members, run, epoch, now)
        for order in orders:
            self._commands.restore(order, now)
        self._reception = Reception(self.members, self._keys, run, epoch)
        self._answers = Answers(
            wire.Frame(run=run, epoch=epoch, env=env, agents=len(channels), heartbeat=rules.heartbeat, problem=frame),
            channels,
            now,
        )
        self.wake_at = now

    def handle(self, event: ev.Event, now: float) -> list[ev.Effect]:
        """What to do about an event. `now` never goes back."""
        out: list[ev.Effect] = []
        self._notice_sleep(now, out)
        match event:
            case ev.Received():
                self._hear(event, now, out)
            case ev.TokenAppeared() | ev.TokenVanished():
                self._token(event, now, out)
            case ev.Queried(key=keys.COMMAND):
                self._command(event, now, out)
            case ev.Ordered(query, request, reason):
                out.append(self._commands.answer(query, request, reason))
            case ev.Queried():
                out += self._answers.answer(event, now, tick=self._tick, phase=self.phase, news=self._news)
            case ev.PlantAdvanced():
                self._advanced(event, now, out)
            case ev.Interrupted(number):
                self._finish(ev.End(ev.Ending.INTERRUPTED, f"signal {number}"), now, out)
        self._pass_time(now, out)
        self._last = now
        self.wake_at = self._next_wake()
        return out

    def _notice_sleep(self, now: float, out: list[ev.Effect]) -> None:
        """Move all deadlines by the time in which this process did not run: nobody else is to blame for it."""
        slept = now - max(self._last, self.wake_at)
        if slept <= self.rules.slept:
            return
        self._move_deadlines(slept, now)
        self._times.forgiving_until = now + max(RECOVERY, self.rules.grace)
        out.append(ev.Note(-1, "slept", slept))

    def _move_deadlines(self, slept: float, now: float) -> None:
        for turn in self._open.values():
            turn.move(slept, now)
        for slot in self.members.slots:
            slot.until, slot.heard_at = slot.until + slept, now
        self.members.look_again()
        self._times.move(slept)

    def _command(self, event: ev.Queried, now: float, out: list[ev.Effect]) -> None:
        """Take an order; a pause that ends was nobody's fault, so all deadlines move."""
        paused_at = self._commands.paused_at
        out += self._commands.take(event, now)
        if paused_at is not None and self._commands.paused_at is None:
            self._move_deadlines(now - paused_at, now)
            out.append(ev.Note(-1, "resumed", now - paused_at))
        elif paused_at is None and self._commands.paused_at is not None:
            out.append(ev.Note(-1, "paused"))

    def _pass_time(self, now: float, out: list[ev.Effect]) -> None:
        if self.ended is not None:
            return
        if now >= self._slots_due():
            self._watch_slots(now, out)
            self.members.look_again()
        if self.phase == "over":
            if now >= self._times.farewell_by or not any(slot.present for slot in self.members.slots):
                self._end(out)
        elif self.phase == "gathering":
            self._gather(now, out)
        else:
            self._play(now, out)
        if now >= self._times.clock_at and self.ended is None:
            self._tell_clock(now, out)

    def _watch_slots(self, now: float, out: list[ev.Effect]) -> None:
        for agent, slot in enumerate(self.members.slots):
            if slot.state == SlotState.BARRED and now >= slot.until:
                self.members.pardon(agent)
            elif slot.state == SlotState.READY and now - slot.heard_at >= self.rules.unheard:
                self._cut(agent, "unheard", now, out)
            if slot.state == SlotState.MISSING and now >= slot.until:
                self._lose(agent, "lost", now, out)

    def _tell_clock(self, now: float, out: list[ev.Effect]) -> None:
        beat = min(self.rules.heartbeat, self.rules.resend) if self.phase == "over" else self.rules.heartbeat
        self._times.clock_at = now + beat
        clock = wire.Clock(run=self._run, epoch=self._epoch, tick=self._tick, phase=self.phase)
        out.append(ev.Put(keys.CLOCK, clock))

    def _next_wake(self) -> float:
        if self.ended is not None:
            return math.inf
        paused = self._commands.paused_at is not None
        times = self._times.due(self._last, gathering=self.phase == "gathering", paused=paused)
        if paused:
            return min(*times, self._slots_due())
        for agent, turn in self._open.items():
            if agent not in self._choices:
                present = self.members.slots[agent].present
                times += [turn.deadline, turn.resend_at] if present else [turn.give_up_at]
        return min(*times, self._slots_due())

    def _slots_due(self) -> float:
        """When a slot has to be looked at, at the earliest; when the run is over they are not looked at any more."""
        return math.inf if self.phase == "over" else self.members.due(self.rules.unheard)

    # ---- phases

    def _gather(self, now: float, out: list[ev.Effect]) -> None:
        missing = self.members.absent()
        if missing and now < self._times.ready_by:
            return
        if missing and not (self._resumed and self.members.quorate(self.rules.quorum)):
            names = ", ".join(f"{self._prefix}_{agent}" for agent in missing)
            reason = f"not there within {self.rules.ready:g} s: {names}"
            self._finish(ev.End(ev.Ending.NOT_GATHERED, reason), now, out)
            return
        for agent in missing:
            if self.members.slots[agent].state in (SlotState.VACANT, SlotState.MISSING):
                self._lose(agent, "lost", now, out)
        self.phase = "running"
        self._times.paced_from, self._times.first_tick = now, self._tick
        self._times.clock_at = now
        self._times.begin_tick(self._tick)
        self._play(now, out)

    def _play(self, now: float, out: list[ev.Effect]) -> None:
        """Ask who can be asked, pass the turns of those who cannot, and apply the choices when all are there."""
        if self._applying or now < max(self._times.held_until, self._times.poll_at):
            return
        if self._over:
            self._finish(ev.End(ev.Ending.COMPLETE), now, out)
            return
        if self._commands.paused_at is not None:
            if self._times.standing_since == math.inf:
                self._times.standing_since, self.phase, self._times.clock_at = now, "standstill", now
            return
        for agent, turn in self._open.items():
            if agent not in self._choices:
                self._drive(agent, turn, now, out)
        if self._stands_still(now):
            if self._times.standing_since == math.inf:
                self._times.standing_since, self.phase, self._times.clock_at = now, "standstill", now
                out.append(ev.Note(-1, "standstill"))
            elif now >= self._times.standing_since + self.rules.standstill:
                reason = f"fewer agents than the quorum, or one that is missing, for {self.rules.standstill:g} s"
                self._finish(ev.End(ev.Ending.QUORUM_LOST, reason), now, out)
            return
        if self._times.standing_since < math.inf:
            out.append(ev.Note(-1, "running", now - self._times.standing_since))
            self._times.standing_since, self.phase, self._times.clock_at = math.inf, "running", now
        if len(self._choices) == len(self._open):
            self._applying = True
            out.append(ev.Apply(tuple(self._choices[agent] for agent in self._open)))

    def _stands_still(self, now: float) -> bool:
        if self.rules.clock == "lockstep" and not self.members.quorate(self.rules.quorum):
            return True
        return any(self._waits_for(turn, now) for agent, turn in self._open.items() if agent not in self._choices)

    def _waits_for(self, turn: OpenTurn, now: float) -> bool:
        """Whether time stands still because this turn's agent is missing."""
        patient = self.rules.clock == "lockstep" or now < self._times.forgiving_until
        missing = self.members.slots[turn.request.agent].state == SlotState.MISSING
        return patient and missing and now < turn.give_up_at

    def _drive(self, agent: int, turn: OpenTurn, now: float, out: list[ev.Effect]) -> None:
        """Ask, ask again, or give one turn up."""
        slot = self.members.slots[agent]
        if agent in self._commands.drained and turn.turn is None:
            self._choices[agent] = ev.Choice(agent, IDLE, ev.Outcome.ABSENT)
            return
        if not slot.present:
            if self._waits_for(turn, now):
                return
            if turn.turn is not None:
                self.members.miss(agent, now - turn.asked_at)
            self._choices[agent] = ev.Choice(agent, IDLE, ev.Outcome.ABSENT)
            return
        if turn.turn is None or turn.turn.incarnation != slot.incarnation:
            if now >= self._times.tick_end:  # the paced clock has gone past this tick
                out.append(ev.Count("tick_overruns"))
                self._choices[agent] = ev.Choice(agent, IDLE, ev.Outcome.LATE)
                return
            self._ask(agent, slot, turn, now)
        if slot.state == SlotState.READY:
            slot.move(SlotEvent.ASK)
            turn.open(now, self.rules, self._times.tick_end)
        if now >= turn.deadline:
            self._late(agent, now - turn.asked_at, now, out)
        elif now >= turn.resend_at and turn.turn is not None:
            turn.resend_at = now + self.rules.resend
            out.append(ev.Put(self._keys.turn(agent), turn.turn, control=True))

    def _ask(self, agent: int, slot: Slot, turn: OpenTurn, now: float) -> None:
        if turn.turn is not None:  # its last incarnation went with this turn open
            self.members.miss(agent, now - turn.asked_at)
        slot.turns += 1
        turn.turn = wire.Turn(
            run=self._run,
            epoch=self._epoch,
            tick=self._tick,
            agent=agent,
            incarnation=slot.incarnation,
            sequence=slot.turns,
            noise=turn.request.noise,
            needs={channel: self._news[channel].sequence for channel in self._channels[agent]},
        )

    def _late(self, agent: int, waited: float, now: float, out: list[ev.Effect]) -> None:
        self._choices[agent] = ev.Choice(agent, IDLE, ev.Outcome.LATE)
        out += [ev.Count("missed_deadlines"), ev.Note(agent, "late", waited)]
        if self.members.miss(agent, waited):
            self._lose(agent, "silent", now, out)
        else:
            self.members.slots[agent].move(SlotEvent.MISS)

    def _advanced(self, event: ev.PlantAdvanced, now: float, out: list[ev.Effect]) -> None:
        for channel, payload in event.changed.items():
            last = self._news.get(channel)
            sequence = last.sequence + 1 if last else 1
            news = wire.News(run=self._run, epoch=self._epoch, channel=channel, sequence=sequence, payload=payload)
            self._news[channel] = news
            out.append(ev.Put(channel, news))
        self._times.poll_at = -math.inf if event.requests or event.over else now + self.rules.poll
        if event.tick != self._tick:
            self._tick = event.tick
            self._times.begin_tick(self._tick)
        self._open = {request.agent: OpenTurn(request) for request in event.requests}
        self._choices, self._applying, self._over = {}, False, event.over

    def _finish(self, ending: ev.End, now: float, out: list[ev.Effect]) -> None:
        """Say that it is over until all agents have left, or for `farewell` seconds."""
        if self.phase == "over":
            return
        self.phase, self._ending = "over", ending
        self._open, self._choices = {}, {}
        self._times.held_until, self._times.standing_since = -math.inf, math.inf
        self._times.farewell_by, self._times.clock_at = now + self.rules.farewell, now
        if not any(slot.present for slot in self.members.slots):
            self._tell_clock(now, out)
            self._end(out)

    def _end(self, out: list[ev.Effect]) -> None:
        self.ended = self._ending
        out.append(self.ended)

    # ---- what is heard

    def _hear(self, event: ev.Received, now: float, out: list[ev.Effect]) -> None:
        match self._reception.read(event, now, out):
            case wire.Decision() as said:
                self._decide(said, now, out)
            case wire.Hello() as said:
                self._reception.greet(said, now, out)
            case wire.Beat() as said:
                self._reception.beat(said, now, out)
            case wire.Goodbye() as said:
                self._part(said, now, out)

    def _decide(self, said: wire.Decision, now: float, out: list[ev.Effect]) -> None:
        turn = self._open.get(said.agent)
        if turn is None or turn.turn is None or not said.answers(turn.turn):
            out.append(ev.Count("stale"))
            return
        slot, choice = self.members.slots[said.agent], self._choices.get(said.agent)
        if choice is not None:
            contradicts = choice.outcome == ev.Outcome.DECIDED and choice.action != said.action
            out.append(ev.Count("contradicted" if contradicts else "stale"))
            return
        if self.members.hear(said.agent, now):
            out.append(ev.Note(said.agent, "returned"))
        if slot.state == SlotState.READY:
            slot.move(SlotEvent.ASK)
        self.members.answered(said.agent)
        if slot.remember(said.remembered, self._tick):
            out.append(ev.Note(said.agent, "memory began"))
        source = f"{said.incarnation}/{said.sequence}"
        self._choices[said.agent] = ev.Choice(said.agent, said.action, ev.Outcome.DECIDED, now - turn.asked_at, source)

    def _part(self, goodbye: wire.Goodbye, now: float, out: list[ev.Effect]) -> None:
        slot = self.members.slots[goodbye.agent]
        if goodbye.incarnation != slot.incarnation:
            out.append(ev.Count("stale"))
            return
        slot.counts = dict(goodbye.counts)
        self.members.leave(goodbye.agent)
        if self.phase != "over":
            out.append(ev.Note(goodbye.agent, "left"))

    def _token(self, event: ev.TokenAppeared | ev.TokenVanished, now: float, out: list[ev.Effect]) -> None:
        whose = self._reception.read_token(event.key, out)
        if whose is None:
            return
        agent, incarnation = whose
        slot = self.members.slots[agent]
        if isinstance(event, ev.TokenVanished):
            if incarnation in slot.tokens:
                slot.tokens.remove(incarnation)
            if slot.present and slot.incarnation == incarnation and self.phase != "over":
                self._cut(agent, "gone", now, out)
            elif slot.present and slot.incarnation == incarnation:
                self.members.leave(agent)
            return
        if incarnation not in slot.tokens:
            slot.tokens.append(incarnation)
        if slot.early is not None and slot.early.incarnation == incarnation:
            self._reception.greet(slot.early, now, out)
        elif incarnation == slot.incarnation and self.members.hear(agent, now):
            out.append(ev.Note(agent, "returned"))
        elif incarnation in slot.fenced:
            self._reception.fence(agent, incarnation, "given_up", now, out)

    def _cut(self, agent: int, why: str, now: float, out: list[ev.Effect]) -> None:
        turn = self._open.get(agent)
        waited = now - turn.asked_at if turn is not None and self.members.slots[agent].state == SlotState.ASKED else 0.0
        until = now + self.rules.grace
        if now < self._times.forgiving_until:
            until = max(until, self._times.forgiving_until)
        self.members.cut(agent, until)
        out.append(ev.Note(agent, why, waited))

    def _lose(self, agent: int, why: str, now: float, out: list[ev.Effect]) -> None:
        slot, turn = self.members.slots[agent], self._open.get(agent)
        if why == "lost" and turn is not None and turn.turn is not None and agent not in self._choices:
            self.members.miss(agent, now - turn.asked_at)  # it went with its turn open
            self._choices[agent] = ev.Choice(agent, IDLE, ev.Outcome.ABSENT)
        self.members.give_up(agent, now)
        out.append(ev.Note(agent, why, slot.waited))
        if slot.state == SlotState.BARRED:
            out.append(ev.Note(agent, "barred"))

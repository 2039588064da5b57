"""The delivery ward once more, in plain Python and from the module page's words: what the kernels are held to."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from marl_sched.noise import time_key, uniform

LOAD = {"early": 1, "active": 2, "birth": 4, "recovery": 1}
HOURS = {"early": (4, 6), "active": (3, 4.5), "birth": (1, 1.5), "recovery": (2, 2)}  # later births, first births
WAITING = {"early": 0.5, "active": 2, "birth": 8, "recovery": 4}
WITHOUT_CARE = {"early": 0.25, "active": 1, "birth": 8, "recovery": 0.5}
NEXT = {"early": "active", "active": "birth", "birth": "recovery"}
CARE = ("birth", "active", "recovery", "early")
LABOUR = 16  # the first stream of a domain


@dataclass
class Woman:
    slot: int
    about: object
    stage: str
    section: int
    state: str = "to come"  # or waiting, in bed, gone
    bed: int | None = None
    nurse: int | None = None
    cared_for: bool = False


@dataclass
class Midwife:
    home: int
    task: Woman | None = None
    walk: int = 0
    handling: int = 0
    choice: int | None = None


@dataclass
class ReferenceWard:
    instance: object
    episode: int
    time: int = 0
    cost: float = 0.0
    census: float = 0.0
    women: list[Woman] = field(default_factory=list)
    nurses: list[Midwife] = field(default_factory=list)

    def __post_init__(self):
        pairs = enumerate(self.instance.patients, start=1)
        self.women = [Woman(slot, about, about.stage, about.section) for slot, about in pairs]
        self.nurses = [Midwife(home) for home in self.instance.nurses]
        self.let_arrive()

    def let_arrive(self):
        for woman in self.women:
            if woman.about.arrival == self.time:
                woman.state = "waiting"

    def acting(self):
        return next((n for n, nurse in enumerate(self.nurses) if nurse.task is None and nurse.choice is None), None)

    def can(self, n, slot):
        woman, me = self.women[slot - 1], self.nurses[n]
        chosen = [other.choice for other in self.nurses]
        being_fetched = any(other.task is woman for other in self.nurses)
        if woman.state not in ("waiting", "in bed") or being_fetched or slot in chosen:
            return False
        if woman.state == "in bed":
            return woman.nurse != n and not woman.cared_for
        taken = {w.bed for w in self.women if w.state == "in bed"}
        free = sum(place == me.home and k not in taken for k, place in enumerate(self.instance.beds))
        promised = [o for o in self.nurses if o.choice and o.home == me.home and self.waits(o.choice)]
        return free > len(promised)

    def waits(self, slot):
        return self.women[slot - 1].state == "waiting"

    def choose(self, slot):
        """The acting nurse's choice; an impossible one is none."""
        n = self.acting()
        self.nurses[n].choice = slot if slot and self.can(n, slot) else 0
        while self.acting() is None:
            self.pass_a_quarter()

    def pass_a_quarter(self):
        self.census += sum(w.state in ("waiting", "in bed") for w in self.women) / 4
        for n, nurse in enumerate(self.nurses):
            if nurse.choice:
                self.send(n, self.women[nurse.choice - 1])
            nurse.choice = None
        self.care()
        for woman in self.women:
            if woman.state in ("waiting", "in bed") and not woman.cared_for:
                rate = (WAITING if woman.state == "waiting" else WITHOUT_CARE)[woman.stage]
                self.cost += rate * (2 if woman.about.high_risk else 1) / 4
        self.labour()
        for nurse in self.nurses:
            if nurse.walk:
                nurse.walk -= 1
            elif nurse.task:
                nurse.handling -= 1
                nurse.task = nurse.task if nurse.handling else None
        self.time += 1
        self.let_arrive()

    def send(self, n, woman):
        nurse = self.nurses[n]
        nurse.walk, nurse.task = abs(nurse.home - woman.section), woman
        nurse.handling = 2 if woman.state == "waiting" else 1
        if woman.state == "waiting":
            taken = {w.bed for w in self.women if w.state == "in bed"}
            free = [k for k, place in enumerate(self.instance.beds) if place == nurse.home and k not in taken]
            woman.state, woman.bed, woman.section = "in bed", free[0], nurse.home
        woman.nurse = n

    def care(self):
        for woman in self.women:
            woman.cared_for = False
        for n, nurse in enumerate(self.nurses):
            if nurse.task:
                nurse.task.cared_for = nurse.walk == 0
                continue
            left = 4
            mine = [w for w in self.women if w.nurse == n and w.state == "in bed"]
            for woman in sorted(mine, key=lambda w: (CARE.index(w.stage), not w.about.high_risk, w.slot)):
                if LOAD[woman.stage] <= left:
                    left -= LOAD[woman.stage]
                    woman.cared_for = True

    def labour(self):
        word = np.uint64(time_key(self.episode, self.time))
        for woman in self.women:
            if woman.state not in ("waiting", "in bed") or (woman.stage == "recovery" and not woman.cared_for):
                continue
            if uniform(word, LABOUR, woman.slot, 0) >= 1 / (4 * HOURS[woman.stage][woman.about.first]):
                continue
            if woman.stage == "recovery":
                self.let_go(woman)
            else:
                woman.stage = NEXT[woman.stage]

    def let_go(self, woman):
        for nurse in self.nurses:
            if nurse.task is woman:
                nurse.task, nurse.walk, nurse.handling = None, 0, 0
        woman.state, woman.bed, woman.nurse, woman.cared_for = "gone", None, None, False

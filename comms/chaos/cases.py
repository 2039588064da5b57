"""The cases of a campaign: what is done to a deployment, and what of it must have happened."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from marl_sched.comms.chaos.scene import Scene
from marl_sched.comms.security.identity import WORLD

AGAIN, RECONNECTED = 2.0, 3.0  # seconds after a fault, and after a cut link: lease, retry and one heartbeat
MEANWHILE = 10.0  # seconds in which all are heard while messages go on faring badly, the observer's too
Behind = Callable[[int], Iterable[int]]


def nobody(n: int) -> Iterable[int]:
    """No agent is behind the link."""
    return ()


def everybody(n: int) -> Iterable[int]:
    """All agents are."""
    return range(n)


def half(n: int) -> Iterable[int]:
    """Every second agent is."""
    return range(0, n, 2)


def first(n: int) -> Iterable[int]:
    """The first agent is."""
    return (0,)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One run to which something happens.

    Attributes:
        fault: does it, when the run runs.
        needs: kinds of faults that must have occurred, else the case has failed.
        world: options of the world that it changes.
        behind: number of agents -> those that reach the world through a link that can be cut.
        heard_s: within which every agent must be heard again.
        attack: whether it is an attack, after which the run must be, with certificates, the one that nobody attacked.
        in_short: whether it belongs to the short campaign.
    """

    name: str
    fault: Callable[[Scene], None]
    needs: tuple[str, ...]
    world: Mapping[str, Any] = field(default_factory=dict)
    behind: Behind = nobody
    heard_s: float = AGAIN
    attack: bool = False
    in_short: bool = False


def _messages(name: str, seconds: float = 8.0, *, short: bool = False, **faults: float) -> Case:
    """A run whose messages fare badly from its first to its last."""

    def watched(scene: Scene) -> None:
        scene.go_on(seconds)
        scene.heard_again()

    world = {"faults": {**faults, "seed": 1}}
    return Case(name=name, fault=watched, needs=tuple(faults), world=world, heard_s=MEANWHILE, in_short=short)


def _watched(scene: Scene) -> None:
    scene.go_on(5.0)
    scene.heard_again()


def _stopped(scene: Scene) -> None:
    name = scene.names[1]
    scene.signal([name], signal.SIGTERM, "stopped")
    scene.until(lambda: scene.deployment.children[name].restarts > 0, "restart")
    scene.heard_again()


def _frozen_bystander(scene: Scene) -> None:
    bystander = scene.intrude("listen", 60.0)
    bystander.send_signal(signal.SIGSTOP)
    scene.faults["frozen"] += 1
    scene.go_on(12.0)
    scene.heard_again()


def _forged(scene: Scene) -> None:
    bystander = scene.intrude("listen", 60.0)
    bystander.send_signal(signal.SIGSTOP)
    scene.faults["frozen"] += 1
    scene.suffer("forge", 10.0)
    scene.heard_again()


def _slow_reader(scene: Scene) -> None:
    scene.suffer("read-slowly", 8.0)
    scene.heard_again()


def _attacked(what: str, seconds: float, certificate: bool = True) -> Callable[[Scene], None]:
    def suffer(scene: Scene) -> None:
        scene.suffer(what, seconds, certificate=certificate)
        scene.heard_again()

    return suffer


def _everything(scene: Scene) -> None:
    """A run for the impatient: an agent and the world killed, an agent frozen, the link cut, over bad messages."""
    scene.kill(scene.names[0])
    scene.kill(WORLD)
    scene.freeze(scene.names[1], 2.0)
    scene.cut(2.0)


CASES: tuple[Case, ...] = (
    _messages("loss 1 %", loss=0.01),
    _messages("loss 10 %", loss=0.1),
    _messages("loss 30 %", loss=0.3, seconds=12.0),
    _messages("delay to 200 ms", delay=0.2, seconds=12.0),
    _messages("duplication 30 %", duplicate=0.3),
    _messages("reordering 30 %", reorder=0.3),
    Case(
        name="outage of 3 s", fault=lambda s: s.cut(3.0), needs=("cut", "held"), behind=everybody, heard_s=RECONNECTED
    ),
    Case(
        name="half the agents cut off for 5 s",
        fault=lambda s: s.cut(5.0),
        needs=("cut", "held"),
        behind=half,
        heard_s=RECONNECTED,
    ),
    Case(
        name="a link of 2 s for one agent",
        fault=lambda s: s.slow_down(2.0, 8.0),
        needs=("slowed", "delayed"),
        behind=first,
        heard_s=RECONNECTED,
    ),
    Case(name="one agent killed", fault=lambda s: s.kill(s.names[1]), needs=("killed",)),
    Case(name="one agent stopped and started", fault=_stopped, needs=("stopped",)),
    Case(name="one agent frozen for 15 s", fault=lambda s: s.freeze(s.names[1], 15.0), needs=("frozen", "thawed")),
    Case(name="all agents killed", fault=lambda s: s.kill(*s.names), needs=("killed",)),
    Case(name="world (hub) killed", fault=lambda s: s.kill(WORLD), needs=("killed",), heard_s=RECONNECTED),
    Case(
        name="one of two routers killed",
        fault=lambda s: s.kill("router_0"),
        needs=("killed",),
        world={"routers": ("tls/127.0.0.1:0", "tls/127.0.0.1:0")},
        heard_s=RECONNECTED,
    ),
    Case(name="world frozen for 3 s", fault=lambda s: s.freeze(WORLD, 3.0), needs=("frozen",), heard_s=RECONNECTED),
    Case(name="world frozen for 15 s", fault=lambda s: s.freeze(WORLD, 15.0), needs=("frozen",), heard_s=RECONNECTED),
    Case(
        name="clock faster than the agents",
        fault=_watched,
        needs=("late",),
        world={"clock": "paced", "pace": 0.0005},
    ),
    Case(
        name="everything, for a moment",
        fault=_everything,
        needs=("killed", "frozen", "cut", "loss", "delay", "duplicate", "reorder"),
        world={"faults": {"loss": 0.05, "delay": 0.01, "duplicate": 0.05, "reorder": 0.05, "seed": 1}},
        behind=half,
        heard_s=RECONNECTED,
        in_short=True,
    ),
    Case(name="slow reader", fault=_slow_reader, needs=("read-slowly",), attack=True),
    Case(name="frozen bystander", fault=_frozen_bystander, needs=("listen", "frozen"), attack=True),
    Case(
        name="forgeries beside a frozen bystander",
        fault=_forged,
        needs=("forge put", "frozen"),
        attack=True,
        in_short=True,
    ),
    Case(name="flood", fault=_attacked("flood", 5.0), needs=("flood put",), attack=True),
    Case(
        name="connections without a right to",
        fault=_attacked("connect", 5.0, False),
        needs=("connect garbage", "connect half_open"),
        attack=True,
    ),
)

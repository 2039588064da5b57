"""What an operator orders: of the team, at exact times, and of plants that cannot do it, which say so."""

from __future__ import annotations

import time
import uuid

import pytest

from marl_sched.comms import orders
from marl_sched.comms.decision_log import FileLog, Header
from marl_sched.comms.inproc import Bus, Threads
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.plant import SimulatedPlant
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.commands import WORDS
from marl_sched.comms.replay import replay
from marl_sched.comms.world import World
from marl_sched.errors import DeploymentError, InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.problem import Problem
from tests.comms.driver import US, WorldDriver, of, turns

ASK = {**US, "request": "r1"}


def order(driver: WorldDriver, now: float, message: wire.Message) -> list[ev.Effect]:
    return driver.at(now, ev.Queried(keys.COMMAND, wire.encode(message), 7))


def test_paused_world_asks_nobody_and_no_deadline_passes_until_it_is_resumed():
    driver = WorldDriver(deadline=2.0)
    (turn,) = turns(driver.gathered(1.0))
    effects = order(driver, 2.0, wire.Team(**ASK, kind="pause"))
    assert ev.Reply(7, wire.Accepted(**ASK)) in effects
    assert of(effects, ev.Note) == [ev.Note(-1, "paused")]
    assert driver.protocol.phase == "standstill"
    for now in range(3, 100):
        driver.keep_alive(float(now))
    assert driver.applied == []
    effects = order(driver, 100.0, wire.Team(**ASK, kind="resume"))
    assert of(effects, ev.Note)[:1] == [ev.Note(-1, "resumed", 98.0)]
    assert driver.protocol.phase == "running"
    driver.keep_alive(100.9)
    driver.at(100.9)
    assert driver.applied == []  # it was asked at 1 and had a second left
    driver.decide(100.95, turn)
    (choice,) = driver.applied
    assert choice == ev.Choice(0, 1, ev.Outcome.DECIDED, pytest.approx(1.95), "a/1")


def test_drained_agent_finishes_its_turn_and_is_not_asked_again_until_it_is_readmitted():
    driver = WorldDriver()
    (turn,) = turns(driver.gathered(1.0))
    order(driver, 1.1, wire.Team(**ASK, kind="drain", agent=0))
    (other,) = turns(driver.decide(1.2, turn))
    assert other.agent == 1
    (again,) = turns(driver.decide(1.3, other))
    assert again.agent == 1  # the next tick, in which agent 0 was passed over
    assert [(c.agent, c.outcome) for c in driver.applied] == [(0, "decided"), (1, "decided"), (0, "absent")]
    order(driver, 1.4, wire.Team(**ASK, kind="readmit", agent=0))
    (mine,) = turns(driver.decide(1.5, again))
    assert mine.agent == 0
    assert driver.slot(0).losses == 0


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (wire.Team(**ASK, kind="drain"), "drain: there is no agent None"),
        (wire.Team(**ASK, kind="readmit", agent=9), "readmit: there is no agent 9"),
        (wire.Team(**ASK, kind="readmit", agent=0), "readmit: nothing keeps agent 0 from deciding"),
        (wire.Team(**{**ASK, "epoch": "e0"}, kind="pause"), "it is to another run or epoch"),
    ],
)
def test_impossible_order_is_declined_with_the_reason(message, reason):
    driver = WorldDriver()
    driver.gathered(1.0)
    assert ev.Reply(7, wire.Declined(**ASK, reason=reason)) in order(driver, 2.0, message)


def test_flood_of_orders_is_answered_at_a_bounded_rate_and_garbage_not_at_all():
    driver = WorldDriver()
    driver.gathered(1.0)
    answered = [of(order(driver, 2.0, wire.Team(**ASK, kind="resume")), ev.Reply) for _ in range(100)]
    assert sum(map(len, answered)) == 4
    assert of(driver.at(9.0, ev.Queried(keys.COMMAND, b"garbage", 8)), ev.Reply) == []


@pytest.mark.parametrize("env", ["airme", "murse"])
@pytest.mark.parametrize("kind", [kind for kind, message in WORDS.items() if message is not wire.Team])
def test_plant_that_cannot_do_it_declines_with_a_reason(env, kind):
    plant = WorldOptions(problem=Problem(env, count=1)).plant()
    given = {"agent": 0} if WORDS[kind] is wire.Operator else {"entity": "plane/3"}
    reason = plant.order(orders.order_of("run", kind, **given))
    assert reason.startswith(f"{env} cannot {kind} ")


def test_order_reaches_the_plant_and_its_answer_the_operator():
    bus = Bus()
    run = Threads(WorldOptions(problem=Problem("airme", count=1, horizon=2)), ["condition"] * 7, bus)
    run.world._open()
    operator = bus.node()
    operator.ask(1, keys.COMMAND, wire.encode(orders.order_of("run", "cancel", entity="plane/3")))
    run.world._turn_once()
    assert wire.decode(operator.receive(0).payload, wire.Declined).reason == "airme cannot cancel work while it runs"


class Workshop(SimulatedPlant):
    """A plant that cancels work; `cancelled` are (hour, entity)."""

    def __init__(self, options: WorldOptions) -> None:
        super().__init__(options.domain, options.telemetry(), options.simulator())
        self.cancelled: list[tuple[int, str]] = []

    def order(self, order: wire.Work | wire.Operator) -> str | None:
        if order.kind != "cancel":
            return super().order(order)
        self.cancelled.append((int(self.simulator.time[0]), order.entity))
        return None


def test_restarted_world_plays_accepted_orders_again_where_they_were_given(tmp_path):
    """The second life of a world whose log holds a cancelled job between its commits, and a drained agent."""
    options = WorldOptions(problem=Problem("airme", count=1, horizon=40))
    plant, path = Workshop(options), tmp_path / "run.jsonl"
    log = FileLog(path, Header.of(options))
    bus = Bus()
    world, operator = World(options, bus.node(), plant=plant, commits=log), bus.node()
    world._open()
    for _ in range(12):
        agent = plant.state().requests[0].agent
        world._perform([ev.Apply((ev.Choice(agent, 0, ev.Outcome.DECIDED, 0.0, "a/1"),))])
    hour = int(plant.simulator.time[0])
    assert hour > 0
    for kind, fields in (("cancel", {"entity": "plane/3"}), ("add", {"entity": "plane/4"}), ("drain", {"agent": 2})):
        operator.ask(1, keys.COMMAND, wire.encode(orders.order_of("run", kind, **fields)))
        world._turn_once()
    agent = plant.state().requests[0].agent
    world._perform([ev.Apply((ev.Choice(agent, 0, ev.Outcome.DECIDED, 0.0, "a/1"),))])
    log.close()

    again = Workshop(options)
    second = World(options, Bus().node(), plant=again, commits=FileLog(path, Header.of(options)))
    assert again.cancelled == plant.cancelled == [(hour, "plane/3")]
    assert second.protocol._commands.drained == {2}
    with pytest.raises(InvalidFileError, match="accepted, not: airme cannot cancel work"):
        replay(path)  # by a simulator that cannot do it


@pytest.mark.slow
def test_operator_pauses_and_resumes_a_live_world_by_its_certificate(tmp_path):
    pytest.importorskip("zenoh")
    from marl_sched.comms.launcher import Deployment
    from marl_sched.comms.options import DeployOptions
    from marl_sched.comms.security.certificates import make_certificates

    make_certificates(tmp_path / "certs", [f"crew_{i}" for i in range(7)])
    world = WorldOptions(
        problem=Problem("airme", count=1, horizon=200), run=f"test-{uuid.uuid4().hex[:12]}", listen="tls/127.0.0.1:0",
        certs=str(tmp_path / "certs"), deadline=30.0, ready_timeout=120.0, standstill=120.0, grace=60.0, clock="paced",
        pace=0.01,
    )  # fmt: skip
    with Deployment(DeployOptions(world=world, policy="random", runtime="onnx")) as deployment:

        def until(phase: str) -> None:
            end = time.monotonic() + 120
            while deployment.phase != phase:
                assert time.monotonic() < end, deployment.phase
                deployment.look(0.05)

        until("running")
        for kind, phase in (("pause", "standstill"), ("resume", "running")):
            orders.send(orders.order_of(world.run, kind), deployment.endpoint, world.certs, 30.0)
            until(phase)
        with pytest.raises(DeploymentError, match="the world declines: airme cannot hold an agent's choices"):
            orders.send(orders.order_of(world.run, "hold", agent=1), deployment.endpoint, world.certs, 30.0)
        report = deployment.wait()
    assert report.ending.kind == "complete"


def test_order_that_is_none_is_refused_before_it_is_sent():
    with pytest.raises(UnknownNameError, match="unknown order 'pauze'; did you mean 'pause'"):
        orders.order_of("run", "pauze")
    with pytest.raises(InvalidOptionError, match=r"order pin: .*agent"):
        orders.order_of("run", "pin")
    with pytest.raises(InvalidOptionError, match=r"order pause: .*entity"):
        orders.order_of("run", "pause", entity="plane/3")


def test_world_that_does_not_answer_is_said():
    with pytest.raises(DeploymentError, match=r"no answer within 0\.01 s"):
        orders.give(Bus().node(), orders.order_of("run", "pause"), 0.01)

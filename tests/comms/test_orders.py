"""What an operator orders: of the team, at exact times, and of plants that cannot do it, which say so."""

from __future__ import annotations

import pytest

from marl_sched.comms import orders
from marl_sched.comms.inproc import Bus, Threads
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.protocol import events as ev
from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.comms.protocol.commands import WORDS
from marl_sched.errors import DeploymentError, InvalidOptionError, UnknownNameError
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

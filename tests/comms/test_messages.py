"""Messages survive the wire, and whatever else comes over it is refused by name."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_sched.comms import messages as wire
from marl_sched.errors import InvalidMessageError, InvalidOptionError

EXAMPLES = [
    wire.Frame(env="airme", agents=7, problem=b"\x00\xff"),
    wire.Clock(tick=3, phase="running"),
    wire.News(sequence=4, payload=b"state"),
    wire.Snapshot(clock=wire.Clock(tick=0, phase="over"), channels={"a/1": wire.News(sequence=1, payload=b"")}),
    wire.SnapshotRequest(agent=2),
    wire.Hello(agent=1, incarnation="i", policy="condition"),
    wire.Welcome(agent=1, incarnation="i"),
    wire.Fenced(agent=1, incarnation="i", reason="late"),
    wire.Turn(tick=3, agent=1, incarnation="i", sequence=9, noise=0.25, needs={"a/1": 4}),
    wire.Decision(tick=3, agent=1, incarnation="i", sequence=9, target=12),
]
DECISION = EXAMPLES[-1]


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_message_comes_back_as_it_was(message):
    assert wire.decode(wire.encode(message), type(message)) == message


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_message_carries_its_type_and_version(message):
    name, version = msgspec.msgpack.decode(wire.encode(message))["type"].split(".")
    assert name.replace("-", "") == type(message).__name__.lower()
    assert int(version) >= 1


@given(payload=st.binary(max_size=80))
def test_arbitrary_bytes_are_refused_with_a_typed_error(payload):
    with pytest.raises(InvalidMessageError, match="not a Decision"):
        wire.decode(payload, wire.Decision)


@given(cut=st.integers(0, len(wire.encode(DECISION)) - 1))
def test_truncated_message_is_refused(cut):
    with pytest.raises(InvalidMessageError):
        wire.decode(wire.encode(DECISION)[:cut], wire.Decision)


@pytest.mark.parametrize(
    "change",
    [{"type": "decision.2"}, {"type": "turn.1"}, {"target": -1}, {"target": "12"}, {"tick": 1.5}, {"more": 1}],
    ids=str,
)
def test_other_versions_types_and_values_are_refused(change):
    said = {**msgspec.msgpack.decode(wire.encode(DECISION)), **change}
    with pytest.raises(InvalidMessageError):
        wire.decode(msgspec.msgpack.encode(said), wire.Decision)


def test_one_of_several_types_is_told_apart_by_its_tag():
    assert wire.decode(wire.encode(EXAMPLES[7]), wire.Turn, wire.Welcome, wire.Fenced) == EXAMPLES[7]
    with pytest.raises(InvalidMessageError, match="not a Turn or Welcome"):
        wire.decode(wire.encode(EXAMPLES[7]), wire.Turn, wire.Welcome)


@pytest.mark.parametrize("field", ["tick", "agent", "incarnation", "sequence"])
def test_decision_answers_only_the_turn_with_the_same_tick_agent_incarnation_and_sequence(field):
    turn = EXAMPLES[8]
    assert DECISION.answers(turn)
    other = "j" if field == "incarnation" else 2
    assert not msgspec.structs.replace(DECISION, **{field: other}).answers(turn)


def test_keys_of_agents_are_taken_apart_as_they_were_put_together():
    keys = wire.AgentKeys("crew")
    assert keys.parse(keys.decision(3)) == (3, "decision", "")
    assert keys.parse(keys.hello(12)) == (12, "hello", "")
    assert keys.parse(keys.alive(0, "17f-a")) == (0, "alive", "17f-a")


@pytest.mark.parametrize("key", ["crew/x/decision", "plane/3/decision", "crew/3/status", "crew/3", ""])
def test_keys_that_no_agent_speaks_by_are_refused(key):
    with pytest.raises(InvalidMessageError, match="not a key of an agent"):
        wire.AgentKeys("crew").parse(key)


@pytest.mark.parametrize("run", ["", "a/b", "*", "a b", "x" * 65])
def test_run_name_that_cannot_be_part_of_a_key_is_refused(run):
    with pytest.raises(InvalidOptionError, match="run: expected"):
        wire.run_prefix(run)


def test_kinds_are_keys_without_numbers():
    assert [wire.kind_of(key) for key in ("plane/3/now", "crew/12/status", "world/clock")] == [
        "plane/now",
        "crew/status",
        "world/clock",
    ]

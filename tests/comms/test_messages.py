"""Messages survive the wire, and whatever else comes over it is refused by name."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_sched.comms.protocol import keys
from marl_sched.comms.protocol import messages as wire
from marl_sched.errors import InvalidMessageError, InvalidOptionError

US = {"run": "run", "epoch": "e1"}
EXAMPLES = [
    wire.Frame(**US, env="toy", agents=7, heartbeat=0.5, problem=b"\x00\xff"),
    wire.Clock(**US, tick=3, phase="running"),
    wire.News(**US, channel="a/1", sequence=4, payload=b"state"),
    wire.Snapshot(**US, tick=0, phase="over", channels=[wire.News(**US, channel="a/1", sequence=1, payload=b"")]),
    wire.SnapshotRequest(**US, agent=2),
    wire.Hello(**US, agent=1, incarnation="i", policy="p"),
    wire.Beat(**US, agent=1, incarnation="i", tick=3, counts={"heard": 4}),
    wire.Goodbye(**US, agent=1, incarnation="i", counts={}),
    wire.Welcome(**US, agent=1, incarnation="i"),
    wire.Fenced(**US, agent=1, incarnation="i", why="given_up", reason="late"),
    wire.Refused(**US, reason="no"),
    wire.Turn(**US, tick=3, agent=1, incarnation="i", sequence=9, noise=0.25, needs={"a/1": 4}),
    wire.Decision(**US, tick=3, agent=1, incarnation="i", sequence=9, action=12),
]
FENCED, TURN, DECISION = EXAMPLES[9], EXAMPLES[11], EXAMPLES[12]


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
    [{"type": "decision.1"}, {"type": "turn.2"}, {"action": -1}, {"action": "12"}, {"tick": 1.5}, {"more": 1}],
    ids=str,
)
def test_other_versions_types_and_values_are_refused(change):
    said = {**msgspec.msgpack.decode(wire.encode(DECISION)), **change}
    with pytest.raises(InvalidMessageError):
        wire.decode(msgspec.msgpack.encode(said), wire.Decision)


def test_one_of_several_types_is_told_apart_by_its_tag():
    assert wire.decode(wire.encode(FENCED), wire.Turn, wire.Welcome, wire.Fenced) == FENCED
    with pytest.raises(InvalidMessageError, match="not a Turn or Welcome"):
        wire.decode(wire.encode(FENCED), wire.Turn, wire.Welcome)


@pytest.mark.parametrize("field", ["epoch", "tick", "agent", "incarnation", "sequence"])
def test_decision_answers_only_the_turn_with_the_same_epoch_tick_agent_incarnation_and_sequence(field):
    assert DECISION.answers(TURN)
    other = "j" if field in ("incarnation", "epoch") else 2
    assert not msgspec.structs.replace(DECISION, **{field: other}).answers(TURN)


@pytest.mark.parametrize(
    ("payload", "version"),
    [
        (wire.encode(DECISION).replace(b"decision.2", b"decision.1"), "decision.1"),
        (wire.encode(DECISION), None),
        (wire.encode(TURN).replace(b"turn.2", b"turn.9"), None),
        (b"\xc1", None),
        (msgspec.msgpack.encode({"type": 3}), None),
        (msgspec.msgpack.encode([1]), None),
        (b"\x91" * 100_000, None),
    ],
)
def test_message_in_another_version_is_told_apart_from_garbage(payload, version):
    assert wire.other_version(payload, wire.Decision) == version


@given(payload=st.binary(max_size=80))
def test_arbitrary_bytes_have_no_version(payload):
    assert wire.other_version(payload, wire.Decision, wire.Hello) is None


def test_keys_of_agents_are_taken_apart_as_they_were_put_together():
    agents = keys.AgentKeys("crew")
    assert agents.parse(agents.decision(3)) == (3, "decision", "")
    assert agents.parse(agents.hello(12)) == (12, "hello", "")
    assert agents.parse(agents.alive(0, "17f-a")) == (0, "alive", "17f-a")


@pytest.mark.parametrize(
    "key",
    [
        "crew/x/decision",
        "plane/3/decision",
        "crew/3/status",
        "crew/3",
        "",
        f"crew/{'1' * 5000}/hello",
        "crew/0/alive/*",
    ],
    ids=lambda key: key[:20],
)
def test_keys_that_no_agent_speaks_by_are_refused(key):
    with pytest.raises(InvalidMessageError, match="not a key of an agent"):
        keys.AgentKeys("crew").parse(key)


@given(key=st.text(max_size=300))
def test_arbitrary_keys_are_taken_apart_or_refused(key):
    try:
        agent, leaf, _ = keys.AgentKeys("crew").parse(key)
    except InvalidMessageError:
        return
    assert key.startswith(f"crew/{int(key.split('/')[1]):0{len(key.split('/')[1])}d}/{leaf}")
    assert agent >= 0


@pytest.mark.parametrize("run", ["", "a/b", "*", "a b", "x" * 65])
def test_run_name_that_cannot_be_part_of_a_key_is_refused(run):
    with pytest.raises(InvalidOptionError, match="run: expected"):
        keys.run_prefix(run)


def test_kinds_are_keys_without_numbers():
    assert [keys.kind_of(key) for key in ("plane/3/now", "crew/12/status", "world/clock")] == [
        "plane/now",
        "crew/status",
        "world/clock",
    ]

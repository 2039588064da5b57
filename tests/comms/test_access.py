"""What Zenoh lets through when everybody shows a certificate, between sessions of this process."""

from __future__ import annotations

import socket
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from marl_sched.comms.protocol import events as ev
from marl_sched.comms.security.certificates import make_certificates
from marl_sched.comms.security.identity import Identity
from marl_sched.comms.transport.endpoints import settle_port
from marl_sched.comms.transport.zenoh_session import ZenohTransport, hub, spoke
from marl_sched.errors import DeploymentError, InvalidOptionError

CHANNELS = [["plane/0/now", "plane/1/now"], ["plane/1/now"]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("certs")
    make_certificates(made, ["crew_0", "crew_1"])
    return made


class Run:
    """A hub of two agents, and sessions that connect to it with a certificate."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.run, self.endpoint = f"test-{uuid.uuid4().hex[:12]}", settle_port("tls/127.0.0.1:0")
        self._folder, self._stack = folder, stack
        identity = Identity(folder, "world")
        self.world = self._opened(lambda: hub(self.run, self.endpoint, "crew", identity=identity, channels=CHANNELS))

    def session(self, name: str) -> ZenohTransport:
        return self._opened(lambda: spoke(self.run, self.endpoint, 30.0, identity=Identity(self._folder, name)))

    def _opened(self, opening: Callable[[], ZenohTransport]) -> ZenohTransport:
        session = opening()
        self._stack.callback(session.close)
        return session


@pytest.fixture
def run(folder):
    with ExitStack() as stack:
        yield Run(folder, stack)


def settle(run: Run, *sessions: tuple[ZenohTransport, int]) -> None:
    """What these agents declared and said so far has reached the hub: a token on the same link comes behind it."""
    run.world.watch("crew/*/alive/*")
    for session, agent in sessions:
        session.announce(f"crew/{agent}/alive/settled")
    assert {run.world.receive(30.0).key for _ in sessions} == {f"crew/{i}/alive/settled" for _, i in sessions}


def test_agent_speaks_under_its_own_key_and_nowhere_else(run):
    agent, other = run.session("crew_0"), run.session("crew_1")
    for key in ("crew/*/hello", "crew/*/decision", "world/clock", "plane/0/now"):
        run.world.subscribe(key)
    for key in ("world/clock", "crew/1/turn", "plane/1/now"):
        other.subscribe(key)
    settle(run, (other, 1))
    for key in ("crew/1/decision", "crew/1/hello", "crew/1/turn", "world/clock", "plane/0/now", "plane/1/now"):
        agent.put(key, b"forged", control=True)
    agent.announce("crew/1/alive/forged")
    agent.put("crew/0/decision", b"mine", control=True)
    assert run.world.receive(30.0) == ev.Received("crew/0/decision", b"mine")
    run.world.put("world/clock", b"true", control=True)
    assert other.receive(30.0) == ev.Received("world/clock", b"true")
    assert other.receive(0.3) is None
    assert run.world.receive(0) is None


def test_agent_hears_what_its_view_allows_and_nothing_else(run):
    agent, other = run.session("crew_0"), run.session("crew_1")
    for session in (agent, other):
        for key in ("**", "plane/*/now", "plane/0/now", "plane/1/now", "crew/0/turn", "world/observed"):
            session.subscribe(key)
    settle(run, (agent, 0), (other, 1))
    for key in ("plane/0/now", "world/observed", "crew/0/turn", "plane/1/now"):
        run.world.put(key, key.encode(), control=True)

    def heard(session: ZenohTransport, last: str) -> set[str]:
        keys = {session.receive(30.0).key}
        while (event := session.receive(0.5)) is not None:
            keys.add(event.key)
        assert last in keys
        return keys

    assert heard(agent, "plane/1/now") == {"plane/0/now", "crew/0/turn", "plane/1/now"}
    assert heard(other, "plane/1/now") == {"plane/1/now"}


def test_agent_gets_its_own_snapshot_and_no_other(run):
    agent = run.session("crew_0")
    run.world.serve("world/snapshot/*")
    agent.ask(1, "world/snapshot/1", b"theirs")
    agent.ask(2, "world/snapshot/0", b"mine")
    query = run.world.receive(30.0)
    assert (query.key, query.payload) == ("world/snapshot/0", b"mine")
    run.world.reply(query.query, b"state")
    assert agent.receive(30.0) == ev.Answered(2, b"state")
    assert run.world.receive(0.3) is None


def test_observer_hears_its_channel_and_says_nothing(run):
    observer = run.session("observer")
    run.world.subscribe("crew/*/decision")
    for key in ("world/observed", "world/clock", "plane/0/now", "crew/0/turn"):
        observer.subscribe(key)
    observer.watch("world/alive")
    run.world.announce("world/alive")
    assert observer.receive(30.0) == ev.TokenAppeared("world/alive")
    observer.put("crew/0/decision", b"forged", control=True)
    for key in ("plane/0/now", "crew/0/turn", "world/observed"):
        run.world.put(key, b"state", control=True)
    assert observer.receive(30.0) == ev.Received("world/observed", b"state")
    assert observer.receive(0.3) is None
    assert run.world.receive(0) is None


def test_whoever_has_no_certificate_of_this_authority_is_not_let_in(run, tmp_path):
    make_certificates(tmp_path, ["crew_0"])  # of another authority
    for connect in (
        lambda: spoke(run.run, run.endpoint, 0.5, identity=Identity(tmp_path, "crew_0")),
        lambda: spoke(run.run, run.endpoint.replace("tls", "tcp"), 0.5),
    ):
        with pytest.raises(DeploymentError, match="no world at"):
            connect()


def test_agent_waits_with_one_connection_for_a_world_that_is_frozen(folder):
    """A listener that is frozen is knocked at once in ten seconds, as it looks at ten connections a second later on."""
    with socket.socket() as frozen:
        frozen.bind(("127.0.0.1", 0))
        frozen.listen(64)
        endpoint = f"tls/127.0.0.1:{frozen.getsockname()[1]}"
        with pytest.raises(DeploymentError, match=r"no world at .* within 2\.5 s: .*timed out"):
            spoke("run", endpoint, 2.5, identity=Identity(folder, "crew_0"))
        frozen.setblocking(False)
        waiting = [frozen.accept()[0]]
        with pytest.raises(BlockingIOError):
            frozen.accept()
        waiting[0].close()


def test_agent_that_listens_in_the_worlds_place_is_not_believed(folder):
    endpoint = settle_port("tls/127.0.0.1:0")
    with ExitStack() as stack:
        stack.callback(hub("run", endpoint, "crew", identity=Identity(folder, "crew_1")).close)
        with pytest.raises(DeploymentError, match="no world at"):
            spoke("run", endpoint, 0.5, identity=Identity(folder, "crew_0"))


def test_encryption_and_certificates_go_together(folder):
    with pytest.raises(InvalidOptionError, match="needs certificates"):
        hub("run", "tls/127.0.0.1:7447", "crew")
    with pytest.raises(InvalidOptionError, match="takes no certificates"):
        spoke("run", "tcp/127.0.0.1:7447", 1.0, identity=Identity(folder, "crew_0"))

"""Certificates, read by the standard library's TLS and not by what wrote them."""

from __future__ import annotations

import os
import socket
import ssl
import stat
import threading
from pathlib import Path

import pytest

from marl_sched.comms.agent_options import AgentOptions
from marl_sched.comms.options import DeployOptions, WorldOptions
from marl_sched.comms.security.certificates import agent_names, make_certificates
from marl_sched.comms.security.identity import Identity
from marl_sched.errors import InvalidFileError, InvalidOptionError
from marl_sched.problem import Problem


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("certs") / "run"
    assert make_certificates(made, ["crew_0", "crew_1"], hosts=["plant.local", "10.0.0.5"]) == [
        "world", "router", "observer", "operator", "crew_0", "crew_1",
    ]  # fmt: skip
    return made


def handshake(folder: Path, server: str, client: str, host: str) -> str:
    """The common name that the server sees; SSLError if either refuses the other."""
    listening = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=folder / "ca.pem")
    listening.verify_mode = ssl.CERT_REQUIRED
    listening.load_cert_chain(folder / f"{server}.pem", folder / f"{server}.key")
    connecting = ssl.create_default_context(cafile=folder / "ca.pem")
    connecting.load_cert_chain(folder / f"{client}.pem", folder / f"{client}.key")
    ours, theirs = socket.socketpair()
    seen: list = []

    def serve() -> None:
        try:
            with listening.wrap_socket(ours, server_side=True) as accepted:
                seen.append(dict(pair[0] for pair in accepted.getpeercert()["subject"])["commonName"])
                accepted.sendall(b"x")
        except ssl.SSLError as error:
            seen.append(error)
            ours.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with connecting.wrap_socket(theirs, server_hostname=host) as connected:
            connected.recv(1)
    finally:
        theirs.close()
        thread.join(20)
    if isinstance(seen[0], ssl.SSLError):
        raise seen[0]
    return seen[0]


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "plant.local", "10.0.0.5"])
def test_world_and_agent_accept_each_other_at_each_address(folder, host):
    assert handshake(folder, "world", "crew_1", host) == "crew_1"


@pytest.mark.parametrize(("server", "client", "host"), [("crew_0", "crew_1", "localhost"), ("world", "crew_1", "else")])
def test_agents_certificate_cannot_serve_nor_the_worlds_at_another_address(folder, server, client, host):
    with pytest.raises(ssl.SSLError):
        handshake(folder, server, client, host)


def test_private_keys_are_their_owners_alone(folder):
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    keys = sorted(folder.glob("*.key"))
    assert [key.stem for key in keys] == ["ca", "crew_0", "crew_1", "observer", "operator", "router", "world"]
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}


def test_later_agents_get_certificates_of_the_same_authority_and_others_keep_theirs(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before = (tmp_path / "crew_0.pem").read_bytes()
    assert make_certificates(tmp_path, ["crew_0", "crew_2"]) == ["crew_2"]
    assert (tmp_path / "crew_0.pem").read_bytes() == before
    assert handshake(tmp_path, "world", "crew_2", "localhost") == "crew_2"
    os.unlink(tmp_path / "ca.key")
    with pytest.raises(InvalidFileError, match=r"ca\.key"):
        make_certificates(tmp_path, ["crew_3"])


def test_ranges_of_names():
    assert agent_names("crew_0,crew_5..crew_7,robot_1..2") == [
        "crew_0", "crew_5", "crew_6", "crew_7", "robot_1", "robot_2",
    ]  # fmt: skip


@pytest.mark.parametrize("text", ["", "crew_5..crew_3", "crew_1..robot_3"])
def test_list_that_names_nobody_is_refused(text):
    with pytest.raises(InvalidOptionError, match=r"crew_0\.\.crew_6"):
        agent_names(text)


def test_names_hosts_and_days_that_cannot_be_are_refused(tmp_path):
    for names, more in ((["a/b"], {}), (["ca"], {}), (["crew_0"], {"hosts": ["no host"]}), (["crew_0"], {"days": 0})):
        with pytest.raises(InvalidOptionError, match=r"agents|host|days"):
            make_certificates(tmp_path / "none", names, **more)
    assert not (tmp_path / "none").exists()


AIRME = Problem("airme", count=1)


def test_process_finds_its_own_certificate_or_says_what_lacks(folder, tmp_path):
    agent = AgentOptions(agent=1, policy="random", certs=str(folder))
    assert agent.identity() == Identity(folder, "crew_1")
    with pytest.raises(InvalidOptionError, match=r"one certificate of agent 5, such as crew_5\.pem, found none"):
        AgentOptions(agent=5, policy="random", certs=str(folder)).identity()
    with pytest.raises(InvalidOptionError, match=r"ca\.pem: there is no such file; `marl-sched certs"):
        WorldOptions(problem=AIRME, certs=str(tmp_path)).identity()


def test_listening_without_certificates_wants_a_word():
    with pytest.raises(InvalidOptionError, match=r"tcp/0\.0\.0\.0:1 is reached by other machines.*--insecure"):
        WorldOptions(problem=AIRME, listen="tcp/0.0.0.0:1")
    with pytest.raises(InvalidOptionError, match=r"whoever reaches it can answer in an agent's name.*--insecure"):
        DeployOptions(world=WorldOptions(problem=AIRME, listen="tcp/127.0.0.1:0"), policy="random")
    WorldOptions(problem=AIRME, listen="tls/0.0.0.0:1")
    DeployOptions(world=WorldOptions(problem=AIRME, listen="tcp/127.0.0.1:0", insecure=True), policy="random")

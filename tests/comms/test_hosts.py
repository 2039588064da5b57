"""World and agents on hosts of their own: network namespaces, joined by links that can be taken down."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from marl_sched.comms.options import WorldOptions
from marl_sched.comms.security.certificates import make_certificates
from marl_sched.domain import get_domain
from marl_sched.problem import Problem

AGENTS = 2


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True, timeout=60)


def obstacle() -> str:
    """Why there can be no hosts here, "" if there can."""
    if os.geteuid() != 0:
        return "network namespaces want root"
    if shutil.which("ip") is None:
        return "the program ip (iproute2) is not installed"
    name = f"test-{uuid.uuid4().hex[:8]}"
    try:
        ip("netns", "add", name)
        ip("netns", "delete", name)
    except subprocess.CalledProcessError as error:
        return f"no network namespace can be made: {error.stderr.strip()}"
    return ""


@dataclass
class Hosts:
    """A host for the world, and one for each agent, which reaches the world by `address(agent)`."""

    name: str

    def build(self) -> None:
        ip("netns", "add", self.world)
        ip("-n", self.world, "link", "set", "lo", "up")
        for agent in range(AGENTS):
            ip("netns", "add", self.agent(agent))
            ours, theirs = self.link(agent), f"{self.link(agent)}a"
            ip(
                "link",
                "add",
                ours,
                "netns",
                self.world,
                "type",
                "veth",
                "peer",
                "name",
                theirs,
                "netns",
                self.agent(agent),
            )
            for host, device, last in ((self.world, ours, 1), (self.agent(agent), theirs, 2)):
                ip("-n", host, "address", "add", f"10.77.{agent}.{last}/24", "dev", device)
                ip("-n", host, "link", "set", device, "up")

    @property
    def world(self) -> str:
        return f"{self.name}-w"

    def agent(self, agent: int) -> str:
        return f"{self.name}-{agent}"

    def link(self, agent: int) -> str:
        return f"v{self.name[-6:]}{agent}"

    def address(self, agent: int) -> str:
        return f"10.77.{agent}.1"

    def start(self, host: str, module: str, options: dict) -> subprocess.Popen[str]:
        command = [sys.executable, "-P", "-m", f"marl_sched.comms.{module}", json.dumps(options)]
        return subprocess.Popen(["ip", "netns", "exec", host, *command], stderr=subprocess.PIPE, text=True)


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    why = obstacle()
    if why:
        pytest.skip(why)
    made = Hosts(f"test-{uuid.uuid4().hex[:6]}")
    try:
        made.build()
        yield made
    finally:
        for host in (made.world, *(made.agent(i) for i in range(AGENTS))):
            subprocess.run(["ip", "netns", "delete", host], check=False, capture_output=True, timeout=60)


def wait_until(condition: Callable[[], bool], seconds: float = 200.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.slow
def test_run_on_three_hosts_outlasts_a_link_that_is_down_for_two_seconds(hosts, in_process, tmp_path):
    instance = replace(get_domain("airme").instances("small", 1, 0)[0], n_crews=AGENTS)
    instance.save(tmp_path / "fleet.json")
    problem = Problem("airme", instances=[tmp_path / "fleet.json"], horizon=600, view={"kind": "local", "reach": 0})
    make_certificates(
        tmp_path / "certs", [f"crew_{i}" for i in range(AGENTS)], hosts=[hosts.address(i) for i in range(2)]
    )
    given = WorldOptions(
        problem=problem, run="hosts", listen="tls/0.0.0.0:7447", certs=str(tmp_path / "certs"), deadline=30.0,
        ready_timeout=200.0, standstill=200.0, grace=60.0, log=str(tmp_path / "run.jsonl"),
        report=str(tmp_path / "report.json"),
    )  # fmt: skip
    processes = [hosts.start(hosts.world, "world", given.as_json())]
    for agent in range(AGENTS):
        options = {
            "agent": agent, "policy": "condition", "run": "hosts", "connect": f"tls/{hosts.address(agent)}:7447",
            "certs": given.certs, "join_timeout": 200.0,
        }  # fmt: skip
        processes.append(hosts.start(hosts.agent(agent), "agent", options))
    try:
        wait_until(lambda: Path(given.log).exists() and Path(given.log).read_bytes().count(b"\n") > 20)
        ip("-n", hosts.world, "link", "set", hosts.link(0), "down")
        time.sleep(2.0)
        ip("-n", hosts.world, "link", "set", hosts.link(0), "up")
        codes = [process.wait(200) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert codes == [0, 0, 0], [process.stderr.read() for process in processes]
    report = json.loads((tmp_path / "report.json").read_text())
    assert "gone" in [event["event"] for event in report["events"] if event["agent"] == "crew_0"]
    assert report["decisions"] == in_process(given, ["condition"] * AGENTS)["decisions"]

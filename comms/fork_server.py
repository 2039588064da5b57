"""A process that has imported and compiled everything, and forks the processes of a deployment from itself.

A forked process is ready in milliseconds and shares the memory of what was imported. No Zenoh session is ever opened
here, as those do not survive a fork. (The standard library's fork server would import the caller's main module into
every process.)

It takes JSON lines on its standard input: `{"start": NAME, "role": ROLE, "options": {...}, "log": PATH}`, where the
role is `world`, `router` or `agent`, and `{"signal": NAME, "number": N}`. It gives JSON lines on its standard output:
`{"ready": true}`, `{"started": NAME, "pid": N}`, `{"ended": NAME, "code": N}`, and what the world says of its progress.
It ends with its standard input and takes all its processes along; if it is killed they end by themselves.
"""

from __future__ import annotations

import json
import logging
import os
import selectors
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_sched.comms.process import SIGNALS, call, end_with, leave, parse_options
from marl_sched.comms.protocol.events import ExitCode
from marl_sched.errors import InvalidOptionError, MarlSchedError

if TYPE_CHECKING:
    from marl_sched.light import Runtime

Roles = dict[str, tuple[type, Callable[..., Any], Callable[[Any], int]]]  # role -> (options' type, body, exit code)
GRACE = 4.0  # seconds that processes have to end when asked to, before they are killed
TICK = 0.05


class ForkServer:
    """See the module's page."""

    def __init__(self, roles: Roles) -> None:
        self._roles = roles
        self._pids: dict[int, str] = {}
        self._alive_read, self._alive_write = os.pipe()  # what ends the forked ones if this process is killed
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)

    def run(self) -> None:
        """Serve until the standard input ends."""
        signal.set_wakeup_fd(self._wake_write)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)  # the parent, not the terminal, ends this process
        self._say({"ready": True})
        with selectors.DefaultSelector() as selector:
            selector.register(0, selectors.EVENT_READ)
            selector.register(self._wake_read, selectors.EVENT_READ)
            rest = b""
            while True:
                ready = {key.fd for key, _ in selector.select()}
                if self._wake_read in ready:
                    os.read(self._wake_read, 4096)
                    self._reap()
                if 0 in ready:
                    chunk = os.read(0, 1 << 16)
                    if not chunk:
                        break
                    *lines, rest = (rest + chunk).split(b"\n")
                    for line in lines:
                        self._obey(json.loads(line))
        self._end_all()

    def _say(self, said: dict[str, Any]) -> None:
        try:
            os.write(1, json.dumps(said).encode() + b"\n")
        except BrokenPipeError:
            logging.getLogger(__name__).info("nobody listens any more")

    def _obey(self, order: dict[str, Any]) -> None:
        if "start" in order:
            signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until the new process has its own handlers
            pid = os.fork()
            if pid == 0:
                self._be(order)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
            self._pids[pid] = order["start"]
            self._say({"started": order["start"], "pid": pid})
            return
        for pid, name in self._pids.items():
            if name == order["signal"]:
                os.kill(pid, order["number"])

    def _reap(self) -> None:
        while self._pids:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            self._say({"ended": self._pids.pop(pid), "code": os.waitstatus_to_exitcode(status)})

    def _end_all(self) -> None:
        end = time.monotonic() + GRACE
        for pid in self._pids:
            os.kill(pid, signal.SIGTERM)
            os.kill(pid, signal.SIGCONT)
        while self._pids and time.monotonic() < end:
            self._reap()
            time.sleep(TICK)
        for pid in self._pids:
            os.kill(pid, signal.SIGKILL)
        while self._pids:
            self._pids.pop(os.wait()[0], None)

    def _be(self, order: dict[str, Any]) -> None:
        """Be one of the processes; never returns."""
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for number in SIGNALS:
                signal.signal(number, leave)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
            os.close(self._alive_write)
            _redirect(Path(order["log"]), keep_stdout=order["role"] == "world")
            end_with(self._alive_read)
            kind, body, exit_code = self._roles[order["role"]]
            code = call(lambda: parse_options(json.dumps(order["options"]), kind), body, exit_code, supervised=True)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)  # what the fork server would do at its end is not ours to do


def _redirect(log: Path, *, keep_stdout: bool) -> None:
    """Read nothing, write to the log; the world's standard output stays, its progress goes there."""
    nothing = os.open(os.devnull, os.O_RDONLY)
    written = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(nothing, 0)
    os.dup2(written, 2)
    if not keep_stdout:
        os.dup2(written, 1)


def warm_up(world: Any, policies: list[str], runtime: Runtime = "torch") -> None:
    """Import, load from disk and compile what the processes are about to use."""
    import numpy as np

    from marl_sched.comms.mind import decider_of
    from marl_sched.comms.plant import SimulatedPlant

    plant = world.plant()
    state = plant.state()
    local = world.telemetry().local_state(plant.frame, 0)
    for channel, payload in state.changed.items():
        if channel in local.channels:
            local.hear(channel, payload)
    for policy in policies:
        decider_of(policy, world.domain, runtime).rehearse(local)
    if isinstance(plant, SimulatedPlant):
        plant.simulator.observe(plant.simulator.acting)
        plant.simulator.step(np.zeros(1, np.int64))


def warm_up_light(name: str, policies: list[str]) -> None:
    """Import what the light agents of a domain are about to use, and nothing that they do without."""
    from marl_sched.comms.mind import decider_of
    from marl_sched.light import light_domain

    domain = light_domain(name)
    if domain is None:
        raise InvalidOptionError(f"{name} has no light declaration")
    for policy in policies:
        decider_of(policy, domain)


def main() -> None:
    """The process: `python -m marl_sched.comms.fork_server ASKED`.

    `ASKED` is `{"world": {...}, "policies": [...], "runtime": "torch" | "onnx", "remove": null}` for worlds and agents,
    where `remove` is a folder that goes when the process ends; `{"light": DOMAIN, "policies": [...]}` for light agents.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    asked = json.loads(sys.argv[1])
    try:
        roles = _light_roles(asked) if "light" in asked else _roles(asked)
    except MarlSchedError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(ExitCode.USER_ERROR)
    ForkServer(roles).run()
    if asked.get("remove"):  # the run's private keys: they go even if the parent was killed
        shutil.rmtree(asked["remove"], ignore_errors=True)


def _roles(asked: dict[str, Any]) -> Roles:
    from marl_sched.comms import agent, router, world
    from marl_sched.comms.agent_options import AgentOptions
    from marl_sched.comms.options import WorldOptions
    from marl_sched.comms.transport import zenoh_session  # noqa: F401  (imported once, for all)

    warm_up(parse_options(json.dumps(asked["world"]), WorldOptions), asked["policies"], asked["runtime"])
    return {
        "world": (WorldOptions, world.serve, world.exit_code_of),
        "agent": (AgentOptions, agent.run, lambda counts: 0),
        "router": (WorldOptions, router.route, lambda nothing: 0),
    }


def _light_roles(asked: dict[str, Any]) -> Roles:
    from marl_sched.comms import agent
    from marl_sched.comms.agent_options import AgentOptions
    from marl_sched.comms.transport import zenoh_session  # noqa: F401  (imported once, for all)

    warm_up_light(asked["light"], asked["policies"])
    return {"agent": (AgentOptions, agent.run, lambda counts: 0)}


if __name__ == "__main__":
    main()

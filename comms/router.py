"""A router between a run's world and its agents: with two of them, the loss of one ends no run.

Routers are linked to each other; the world and every agent connect to one of them, and to another when that is gone.
They hold the access rules that the world holds where agents connect to it: an agent speaks under its own key and hears
what its view allows. The world and the routers are told from others by their certificates, so routers need these.

By hand: `marl-sched router`, with the words for the problem that the world has.
"""

from __future__ import annotations

import signal
import threading

import zenoh

from marl_sched.comms.logs import set_up_logs
from marl_sched.comms.options import WorldOptions
from marl_sched.comms.process import SIGNALS, run_process
from marl_sched.comms.security.access import router_rules
from marl_sched.comms.security.identity import ROUTER
from marl_sched.comms.security.refusals import counted_refusals
from marl_sched.comms.transport.zenoh_session import close_soon, config_of
from marl_sched.comms.world import Refusals
from marl_sched.errors import DeploymentError, InvalidOptionError

RETRY = {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2.0}


def route(options: WorldOptions, progress: object = None) -> None:
    """Route for a run until a signal comes. `options` are the world's, with this router's own endpoint as `listen`.

    Raises InvalidOptionError without certificates, DeploymentError if the endpoint is in use.
    """
    stopped = threading.Event()
    for number in SIGNALS:  # from the first line on: none is lost while the session is opened
        signal.signal(number, lambda number, frame: stopped.set())
    identity = options.identity(ROUTER)
    if identity is None:
        raise InvalidOptionError("router: expected --certs: a router tells the world from others by its certificate")
    set_up_logs(options.log_format, "router", options.run)
    others = [endpoint for endpoint in options.routers if endpoint != options.listen]
    refused = Refusals()
    config = config_of(
        options.listen,
        options.lease,
        identity,
        mode="router",
        listen={"endpoints": [options.listen]},
        connect={"endpoints": others, "timeout_ms": -1, "exit_on_failure": False, "retry": RETRY},
        access_control=router_rules(options.run, options.domain.agent_prefix, options.plant().channels),
    )
    with counted_refusals(refused.count, refused.tell):
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            raise DeploymentError(f"cannot listen on {options.listen}: {error}") from error
        try:
            stopped.wait()
        finally:
            close_soon(session)


if __name__ == "__main__":
    run_process(WorldOptions, route)

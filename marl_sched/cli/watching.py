"""`marl-sched watch`, and the same beside a deployment: agents and timeline in the terminal or on a page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli.plant_options import Certs, endpoint_of

if TYPE_CHECKING:
    from marl_sched.comms.dashboard.watcher import Watcher
    from marl_sched.comms.launcher import Deployment

Web = Annotated[
    int | None,
    typer.Option(
        "--web", metavar="PORT", min=0, max=65535, help="Show the run on a page of this machine; 0: a free port."
    ),
]


def watch(
    run: Annotated[str, typer.Option("--run", help="The world's run.")] = "run",
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="Where the world listens (default: 127.0.0.1:7447).")
    ] = "",
    certs: Certs = None,
    web: Web = None,
) -> None:
    """Look at a running deployment, in this terminal or in a browser, without touching it."""
    from marl_sched.comms.dashboard.terminal import follow

    with (
        _watching(run, connect or endpoint_of(certs is not None, 7447), str(certs or "")) as watcher,
        _page(watcher, web),
    ):
        try:
            follow(watcher)
        except KeyboardInterrupt:
            typer.echo("no longer looking; the run goes on", err=True)


@contextmanager
def shown(deployment: Deployment, live: bool, web: int | None) -> Iterator[None]:
    """Show a deployment while it runs, in the terminal or on a page or not at all."""
    if not live and web is None:
        yield
        return
    from marl_sched.comms.dashboard.terminal import following

    with ExitStack() as stack:
        given = deployment.options.world
        watcher = stack.enter_context(_watching(given.run, deployment.endpoint, deployment.certs))
        stack.enter_context(_page(watcher, web))
        if live:
            stack.enter_context(following(watcher))
        yield


def _watching(run: str, endpoint: str, certs: str) -> Watcher:
    from marl_sched.comms.dashboard.watcher import Watcher
    from marl_sched.comms.security.identity import OBSERVER, Identity
    from marl_sched.comms.transport.zenoh_session import spoke

    identity = Identity(Path(certs), OBSERVER) if certs else None
    return Watcher(lambda: spoke(run, endpoint, 1.0, identity=identity))


@contextmanager
def _page(watcher: Watcher, port: int | None) -> Iterator[None]:
    if port is None:
        yield
        return
    from marl_sched.comms.dashboard.web import serving

    with serving(watcher, port) as server:
        typer.echo(f"the run is shown at {server.address}", err=True)
        yield

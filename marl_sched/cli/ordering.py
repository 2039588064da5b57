"""`marl-sched order`: what an operator orders of a running world."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def add_to(app: typer.Typer) -> None:
    """Register this file's command."""
    app.command(epilog="Example: marl-sched order drain --agent 3 --certs certs --connect tls/plant:7447")(order)


def order(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="ORDER", help="pause, resume, drain, readmit; pin, forbid, force, hold; add, cancel, repeat, ..."
        ),
    ],
    certs: Annotated[Path, typer.Option("--certs", metavar="DIR", help="Certificates, the operator's among them.")],
    run: Annotated[str, typer.Option("--run", help="The world's run.")] = "run",
    connect: Annotated[
        str, typer.Option("--connect", metavar="ENDPOINT", help="Where the world listens.")
    ] = "tls/127.0.0.1:7447",
    agent: Annotated[int | None, typer.Option("--agent", metavar="I", help="Index of the agent that it binds.")] = None,
    action: Annotated[int | None, typer.Option("--action", help="The action that it binds.")] = None,
    until: Annotated[int | None, typer.Option("--until", help="Simulated time until which it holds.")] = None,
    entity: Annotated[str | None, typer.Option("--entity", help="The work that it changes.")] = None,
    priority: Annotated[float | None, typer.Option("--priority", help="Its new priority.")] = None,
) -> None:
    """Order something of a running world: pause, resume, take agents out and in, bind choices, change the work."""
    from marl_sched.comms import orders

    fields = {"agent": agent, "action": action, "until": until, "entity": entity, "priority": priority}
    orders.send(orders.order_of(run, kind, **fields), connect, str(certs))

"""`marl-sched chaos`: faults and attacks on a deployment of this machine, and what came of them."""

from __future__ import annotations

import signal
import tempfile
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, OwnOptions, takes
from marl_sched.errors import InvalidOptionError

FUZZED, STOPS = 100_000, 50  # payloads and keys; deployments that are ended

if TYPE_CHECKING:
    from marl_sched.comms.chaos.campaign import Row
    from marl_sched.comms.options import WorldOptions
    from marl_sched.domain import Domain


def add_to(app: typer.Typer) -> None:
    """Register this file's command."""
    example = f"Example: marl-sched chaos --env {options.DEFAULT_ENV} --case killed --json chaos.json"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes(Team)(chaos))


@dataclass(frozen=True, kw_only=True)
class Team:
    """What is played while things go wrong; each field but `own` is an option."""

    env: options.Env = options.DEFAULT_ENV
    scale: options.Scale = None
    seed: options.Seed = 0
    view: Annotated[
        str, typer.Option("--view", help="What an acting agent sees (default: the environment's first local view).")
    ] = ""
    own: OwnOptions

    def world(self, domain: Domain) -> WorldOptions:
        """The plant, which everybody waits for as long as a busy machine may need."""
        from marl_sched.comms.options import WorldOptions

        view = self.view or next((kind for kind in domain.views if kind != "full"), "full")
        problem = options.state_problem(self.env, self.own, scale=self.scale, view=view, seed=self.seed, episodes=1)
        return WorldOptions(
            problem=problem,
            run=f"chaos-{uuid.uuid4().hex[:8]}",
            listen="tls/127.0.0.1:0",
            deadline=5.0,
            ready_timeout=200.0,
        )


def chaos(
    team: Team,
    *,
    policy: Annotated[str, typer.Option("--policy", help="What decides (default: the environment's choice).")] = "",
    full: Annotated[
        bool, typer.Option("--full", help="All cases; by default the few that take half a minute.")
    ] = False,
    case: Annotated[
        list[str] | None, typer.Option("--case", metavar="TEXT", help="Cases whose name has this; may be repeated.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--folder", metavar="DIR", help="Where to keep all logs (default: nowhere).")
    ] = None,
    json: options.JsonFile = None,
) -> None:
    """Let things go wrong in a deployment, hold its log against the invariants, and say what it cost."""
    from marl_sched.comms.chaos.campaign import Row, as_json, campaign, exit_code, fuzz_row, stops_row, table
    from marl_sched.comms.chaos.cases import CASES
    from marl_sched.comms.process import SIGNALS, leave
    from marl_sched.domain import get_domain
    from marl_sched.files import write_json

    options.check_output(json)
    for number in SIGNALS:
        signal.signal(number, leave)  # which ends what was started, and removes the folders
    domain = get_domain(team.env)
    policy = policy or (domain.demo.local_rules[0] if domain.demo else "")
    if not policy:
        raise InvalidOptionError(f"--policy: the environment {domain.name!r} does not say what is to decide")
    chosen = [one for one in CASES if (full or one.in_short) and not case]
    chosen += [one for one in CASES if any(text in one.name for text in case or [])]
    if not chosen:
        raise InvalidOptionError(f"--case: expected a part of one of {', '.join(one.name for one in CASES)}")
    with tempfile.TemporaryDirectory(prefix="marl_sched-chaos-") as temporary:
        world, rows = team.world(domain), list[Row]()

        def tell(row: Row) -> None:
            rows.append(row)
            _tell(row)
            if json not in (None, options.STDOUT):  # so that what is there stays if the campaign is ended
                write_json(json, as_json(rows))

        campaign(world, policy, folder or Path(temporary), chosen, tell)
        if full and not case:
            tell(fuzz_row(FUZZED))
            tell(stops_row(STOPS, world, policy))
    typer.echo(table(rows), err=json == options.STDOUT)
    if json == options.STDOUT:
        write_json(json, as_json(rows))
    if exit_code(rows):
        raise typer.Exit(exit_code(rows))


def _tell(row: Row) -> None:
    without = "" if row.secure else ", no certificates"
    typer.echo(f"{row.case}{without}: {'; '.join(row.problems) or 'held'} ({row.seconds} s)", err=True)

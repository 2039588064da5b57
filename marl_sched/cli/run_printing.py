"""A run as it goes on and ends, in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from marl_sched.comms.metrics.report import AgentReport, RunReport


@contextmanager
def progress_bar(hidden: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """A bar on stderr, where there is a terminal, that follows (phase, simulated time, horizon)."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=hidden or not console.is_terminal) as progress:
        task = progress.add_task("starting", total=None)

        def tell(phase: str, tick: int, horizon: int) -> None:
            progress.update(task, description=phase, completed=tick, total=horizon or None)

        yield tell


def finish(report: RunReport) -> None:
    """Print the end of a run, and exit as it ended."""
    print_report(report)
    if report.ending.exit_code:
        raise typer.Exit(report.ending.exit_code)


def print_report(report: RunReport) -> None:
    """The end of a run in a few lines."""
    latency, messages = report.latency_ms, report.messages
    if report.ending.kind != "complete":
        typer.echo(f"the run did not come to its end: {report.ending.reason}")
    typer.echo(f"{report.progress} {report.unit}, {len(report.agents)} agents, {len(report.decisions)} decisions")
    typer.echo(f"M1 ({report.objective}): {report.M1:.4f}")
    _print_shares(report.agents)
    if report.from_log is not None:
        return
    typer.echo(f"{messages.count} messages, {messages.bytes} bytes")
    if latency.p50 is not None and latency.p99 is not None:
        typer.echo(f"decision latency: p50 {latency.p50:.2f} ms, p99 {latency.p99:.2f} ms")
    for death in report.deaths:
        typer.echo(f"lost: {report.time_unit} {death.time}, {death.agent}, {death.event}, waited {death.waited_s} s")


def _print_shares(agents: list[AgentReport]) -> None:
    """How evenly the agents worked, where the environment counts that."""
    shares = {one.name: one.figures["utilisation"] for one in agents if "utilisation" in one.figures}
    if not shares:
        return
    least, most = min(shares, key=shares.__getitem__), max(shares, key=shares.__getitem__)
    typer.echo(
        f"utilisation of agents: {sum(shares.values()) / len(shares):.3f}, "
        f"from {least} {shares[least]:.3f} to {most} {shares[most]:.3f}"
    )

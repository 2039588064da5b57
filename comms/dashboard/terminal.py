"""A run as a table in a terminal, which follows it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from marl_sched.comms.dashboard.watcher import Watcher

COLOURS = {"ready": "green", "asked": "cyan", "missing": "yellow", "lost": "red", "barred": "red", "left": "dim"}
WIDTH = 48  # characters of the timeline
GLYPHS = "123456789abcdefghijklmnopqrstuvwxyz"


def timeline(lane: list[tuple[int, int, str]], tick: int, width: int = WIDTH) -> str:
    """What an agent chose in the last `width` units of time, a character each: `.` nothing, `x` a choice in vain."""
    shown = ["."] * width
    first = max(tick + 1 - width, 0)
    ends = [at for at, _, _ in lane[1:]] + [tick + 1]
    for (at, action, outcome), end in zip(lane, ends, strict=False):
        glyph = "." if action == 0 else GLYPHS[(action - 1) % len(GLYPHS)] if outcome == "decided" else "x"
        for moment in range(max(at, first), min(max(end, at + 1), first + width)):
            shown[moment - first] = glyph
    return "".join(shown[: tick + 1 - first])


def picture(state: dict[str, Any]) -> RenderableType:
    """The state of a run (RunState.as_dict) as a terminal shows it."""
    if state["phase"] == "waiting":
        return Text("waiting for the world")
    head = Text(f"run {state['run']}: {state['phase']}, {state['unit']} {state['tick']} of {state['horizon']}\n")
    head.append(
        f"{state['decisions']} decisions, {state['decisions_per_s']} per second, {state['conflicts']} conflicts"
    )
    head.append("".join(f", {name} {value:.4g}" for name, value in state["objectives"].items()))
    if state["silent_s"] > 2:
        head.append(f"\nnothing heard of the world for {state['silent_s']:.0f} s", style="bold red")
    table = Table("agent", "state", "policy", "turns", "lost", "silent", f"last {WIDTH} {state['unit']}s")
    for agent in state["agents"]:
        table.add_row(
            agent["name"],
            Text(agent["state"], style=COLOURS.get(agent["state"], "")),
            agent["policy"],
            str(agent["turns"]),
            str(agent["losses"]),
            f"{agent['silent_s']:.1f} s",
            Text(timeline(agent["lane"], state["tick"])),
        )
    counts = ", ".join(f"{kind} {count}" for kind, count in state["counts"].items()) or "nothing unusual"
    tail = Text(f"counted: {counts}\nlast error: {state['last_error'] or 'none'}")
    return Group(head, table, tail)


def follow(watcher: Watcher, console: Console | None = None) -> None:
    """Show a run until it is over or the watcher has ended."""
    console = console or Console(stderr=True)
    with Live(picture(watcher.state()), console=console, refresh_per_second=4) as live:
        while not watcher.ended:
            state = watcher.state()
            live.update(picture(state))
            if state["phase"] == "over":
                return
            with watcher.changed:
                watcher.changed.wait(0.5)


@contextmanager
def following(watcher: Watcher) -> Iterator[None]:
    """Show a run while the block lasts."""
    stopped = threading.Event()

    def show() -> None:
        with Live(picture(watcher.state()), console=Console(stderr=True), auto_refresh=False) as live:
            while not stopped.wait(0.25):
                live.update(picture(watcher.state()), refresh=True)

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()

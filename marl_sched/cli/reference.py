"""Every command and its options as Markdown, for the documentation site: what `--help` says, on one page."""

from __future__ import annotations

from typing import Any

import typer


def commands_as_markdown() -> str:
    """A section for each command, in the order of `marl-sched --help`: what it does, options, an example."""
    from marl_sched.cli.app import app

    group: Any = typer.main.get_command(app)
    return "\n\n".join(_section(name, command) for name, command in group.commands.items())


def _section(name: str, command: Any) -> str:
    lines = [
        f"## marl-sched {name}",
        "",
        _one_line(command.help),
        "",
        "| option | default | meaning |",
        "|---|---|---|",
    ]
    lines += [_row(parameter) for parameter in command.params]
    if command.epilog:
        lines += ["", "```text", command.epilog.removeprefix("Example: "), "```"]
    return "\n".join(lines)


def _row(parameter: Any) -> str:
    names = ", ".join(f"`{name}`" for name in parameter.opts)
    takes = f" `{parameter.metavar}`" if parameter.metavar else ""
    if getattr(parameter, "required", False):
        default = "required"
    elif parameter.default in (None, False, ""):
        default = ""
    else:
        default = f"`{parameter.default}`"
    return f"| {names}{takes} | {default} | {_one_line(getattr(parameter, 'help', '')).replace('|', chr(92) + '|')} |"


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())

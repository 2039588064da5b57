"""What MkDocs fills into pages: the commands' options, and the protocol's place on the site."""

from __future__ import annotations

from typing import Any

from marl_sched.cli.reference import commands_as_markdown


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for every page before it is rendered."""
    if page.file.src_uri == "reference/commands.md":
        return markdown.replace("<!-- commands -->", commands_as_markdown())
    return markdown.replace("](../comms/PROTOCOL.md", "](protocol.md")  # the repository's own place of it

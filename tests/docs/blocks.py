"""The code of a page as a reader meets it: its blocks, in order, and how to run them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 900  # seconds: a page takes half a minute on an idle core
LANGUAGES = ("python", "sh")  # blocks of other languages, and those with a title, are shown, not run
# A reader plays a hundred instances, a test a few: the same command, less of it.
LESS = {
    r"--instances (\d+)": "--instances 2",
    r"--episodes (\d+)": "--episodes 1",
    r"--hours (\d+)": "--hours 24",
    r"(marl-sched (?:compare|evaluate) --env airme)": r"\1 --hours 48",
    r"pip install .*": ":",  # installed already
}


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, and the line of the page on which it begins."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page that are run, in order."""
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type == "fence" and token.info.strip() in LANGUAGES and token.map is not None:
            yield Block(token.info.strip(), token.content, token.map[0] + 1)


def run_page(page: Path, folder: Path) -> None:
    """Run a page's blocks in an empty folder: commands in a shell, all Python in one process, each where it stands.

    Python blocks that follow each other, commands between them or not, share their names; AssertionError names the
    page and the line of a block that fails, with what it printed.
    """
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "MPLBACKEND": "agg"}
    script = [
        "import subprocess, linecache",
        f"page = {str(page)!r}",
        "names = {'__name__': '__main__'}",
    ]
    for block in blocks(page):
        script.append(f"print('### line', {block.line}, flush=True)")
        if block.language == "sh":
            script.append(f"subprocess.run(['bash', '-euc', {_less(block.text)!r}], check=True)")
        else:
            source = "\n" * block.line + block.text  # tracebacks then name the page's own lines
            script.append(f"exec(compile({source!r}, page, 'exec'), names)")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(script)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == 0, f"{page.name}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


def _less(text: str) -> str:
    for pattern, replacement in LESS.items():
        text = re.sub(pattern, replacement, text)
    return text

"""The command line: `marl-sched`, or `python -m marl_sched.cli`.

One file per group of commands. Heavy imports stand inside the commands, so that `--help` and `list` answer at
once and work without torch and Zenoh.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command (default: the process's own arguments) and raise SystemExit with its exit code.

    0: done. 2: something that the user can mend, said in one line on stderr. 130: interrupted. Anything else
    is a defect and keeps its traceback.
    """
    from marl_sched.cli.app import run

    raise SystemExit(run(arguments))

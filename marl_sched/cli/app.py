"""The application: its commands, and how it ends when something is wrong."""

from __future__ import annotations

import codecs
import io
import os
import sys
import unicodedata
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from marl_sched.cli import (
    advice,
    bound,
    chaos,
    demo,
    deployment,
    evaluation,
    information,
    ordering,
    pages,
    problems,
    schedules,
    sheets,
    training,
)
from marl_sched.errors import InvalidSheetError, MarlSchedError

app = typer.Typer(
    name="marl-sched",
    help="Schedulers that decide for themselves: generate problems, train, evaluate, deploy as processes.",
    context_settings={"help_option_names": ["-h", "--help"]},
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
_GROUPS = (
    problems, sheets, advice, schedules, evaluation, pages, bound, training, deployment, ordering, chaos, demo,
    information,
)  # fmt: skip
for group in _GROUPS:
    group.add_to(app)

# Newer typer ships click inside itself, older ones depend on it: the base of all its errors of usage is reached
# through the one that both export.
_UsageError: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")

# How letters that a terminal may lack are written in ASCII: plus-minus, times, dashes, ellipsis, sharp s, comparisons,
# lines of tables and progress bars.
_PLAIN = {
    "\u00b1": "+/-",
    "\u00d7": "x",
    "\u2013": "-",
    "\u2014": "-",
    "\u2026": "...",
    "\u00df": "ss",
    "\u2264": "<=",
    "\u2265": ">=",
    "\u2500": "-",
    "\u2501": "-",
}

INTERRUPTED = 130

# The optional dependencies by the module that is missing without them.
EXTRAS = {
    "torch": "train",
    "torchrl": "train",
    "tensordict": "train",
    "safetensors": "train",
    "hydra": "train",
    "omegaconf": "train",
    "tensorboard": "train",
    "zenoh": "deploy",
    "cryptography": "deploy",
    "onnxruntime": "light",
    "onnx": "onnx-export",
    "onnxscript": "onnx-export",
    "ortools": "solvers",
    "matplotlib": "plots",
}


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    """What happens before any command."""
    if version:
        import marl_sched

        typer.echo(f"marl-sched {marl_sched.__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code. See `marl_sched.cli.main`."""
    _print_anywhere()
    os.environ.pop("MPLBACKEND", None)  # figures ask for no display, and a notebook's backend may not be installed here
    try:
        code = app(args=None if arguments is None else list(arguments), standalone_mode=False)
    except _UsageError as error:
        return _refuse(error.format_message())
    except InvalidSheetError as error:
        return max(_refuse(line) for line in error.lines)
    except MarlSchedError as error:
        return _refuse(str(error))
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRAS:
            raise
        return _refuse(f"this needs {module}, which is not installed: pip install 'marl-sched[{EXTRAS[module]}]'")
    except OSError as error:
        if error.filename is None:
            raise
        return _refuse(f"{error.filename}: {error.strerror}")
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    if code == INTERRUPTED:  # newer typer makes an exit code of the interrupt
        print("interrupted", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _print_anywhere() -> None:
    """Let output that an ASCII or Latin-1 terminal cannot show be written in its letters instead of raising."""
    codecs.register_error("marl_sched.plain", _plainly)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="marl_sched.plain")


def _plainly(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = unicodedata.normalize("NFKD", error.object[error.start : error.end])
    plain = "".join(_PLAIN.get(letter, letter if letter.isascii() else "") for letter in letters)
    return plain or "?", error.end


def _refuse(message: str) -> int:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return 2

"""Options that several commands share, declared once as the fields of a dataclass, and those that a domain brings."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import typer

from marl_sched.errors import InvalidOptionError

# What a command needs whose group has a field `own`: options that it does not know go to the domain.
DOMAIN_OPTIONS = {"allow_extra_args": True, "ignore_unknown_options": True}


class OwnOptions:
    """The options that a command does not have itself, as they were typed: name without dashes -> text.

    `command` are the names of those that it has, for suggestions.
    """

    def __init__(self, words: Mapping[str, str], command: Sequence[str] = ()) -> None:
        self.words, self.command = dict(words), tuple(command)


def takes(group: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Turn a command whose first parameter is a dataclass `group` into one that takes the fields, as Typer reads it.

    The group's fields are annotated like the parameters of a command and come first in `--help`. A field `own` takes
    the options that the command does not have itself; the command is then registered with DOMAIN_OPTIONS.
    """
    fields = list(inspect.signature(group, eval_str=True).parameters.values())
    shared = [field for field in fields if field.name != "own"]
    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)

    def wrap(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]

        def call(context: typer.Context, **given: Any) -> None:
            values = {parameter.name: given.pop(parameter.name) for parameter in shared}
            if len(shared) < len(fields):
                known = [option for parameter in context.command.params for option in parameter.opts]
                values["own"] = OwnOptions(parse_options(context.args), known)
            command(group(**values), **given)

        parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in (*shared, *own)]
        call.__name__, call.__doc__ = command.__name__, command.__doc__
        call.__signature__ = inspect.Signature([context, *parameters])  # type: ignore[attr-defined]  # what inspect looks for
        call.__annotations__ = {parameter.name: parameter.annotation for parameter in [context, *parameters]}
        return call

    return wrap


def takes_own(command: Callable[..., None]) -> Callable[..., None]:
    """Turn a command whose first parameter is an OwnOptions into one that hands it what it does not know itself.

    Register it with DOMAIN_OPTIONS.
    """
    parameters = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)

    def call(context: typer.Context, **given: Any) -> None:
        known = [option for parameter in context.command.params for option in parameter.opts]
        command(OwnOptions(parse_options(context.args), known), **given)

    keyword = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    call.__name__, call.__doc__ = command.__name__, command.__doc__
    call.__signature__ = inspect.Signature([context, *keyword])  # type: ignore[attr-defined]  # what inspect looks for
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in [context, *keyword]}
    return call


def parse_options(arguments: Sequence[str]) -> dict[str, str]:
    """`--reach 1 --fast=yes` as {"reach": "1", "fast": "yes"}; InvalidOptionError for what has another form."""
    words: dict[str, str] = {}
    left = list(arguments)
    while left:
        option = left.pop(0)
        if not option.startswith("--") or option == "--":
            raise InvalidOptionError(f"{option}: expected an option such as --name value")
        name, found, value = option[2:].partition("=")
        if not found:
            if not left or left[0].startswith("--"):
                raise InvalidOptionError(f"{option}: expected a value after it")
            value = left.pop(0)
        if name in words:
            raise InvalidOptionError(f"--{name}: expected it once, got {words[name]} and {value}")
        words[name] = value
    return words

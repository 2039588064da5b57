"""Typed errors: every one names what is wrong, where, and what was expected.

The command line prints the message of a `MarlSchedError` as one line and exits with code 2; anything
else is a defect and keeps its traceback.
"""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable
from typing import Any


class MarlSchedError(Exception):
    """Base of all errors that a user can cause and mend."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as message and attributes, so that it arrives from another process whatever its constructor takes."""
        return _restored, (type(self), self.args, dict(vars(self)))


class UnknownNameError(MarlSchedError, ValueError):
    """A name that is not registered; the message lists the names that are."""

    def __init__(self, what: str, name: object, known: Iterable[str]) -> None:
        names = sorted(known)
        close = difflib.get_close_matches(str(name), names, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        super().__init__(f"unknown {what} {name!r}{hint} Known: {', '.join(names) or 'none'}")
        self.what, self.name, self.known = what, name, names


class InvalidFileError(MarlSchedError, ValueError):
    """A file that does not hold what it should: `FILE: field: expected ..., got ...`."""

    def __init__(self, path: object, field: str, expected: str, got: object | None = None) -> None:
        tail = "" if got is None else f", got {_shorten(got)}"
        where = f"{path}: {field}: " if field else f"{path}: "
        super().__init__(f"{where}expected {expected}{tail}")
        self.path, self.field = str(path), field


class InvalidSheetError(InvalidFileError):
    """A spreadsheet with cells that do not hold what they should; `lines` has one complaint for each of them."""

    def __init__(self, path: object, lines: Iterable[str]) -> None:
        self.lines = list(lines)
        MarlSchedError.__init__(self, "\n".join(self.lines))
        self.path, self.field = str(path), ""


class InvalidOptionError(MarlSchedError, ValueError):
    """An option outside its domain, such as a negative reach or a horizon of zero hours."""


class IllegalActionError(MarlSchedError, ValueError):
    """A choice that the action mask forbids or that lies outside the action space."""


class InvalidMessageError(MarlSchedError, ValueError):
    """A message from the wire that does not parse or contradicts the channel it came on."""


class DeploymentError(MarlSchedError, RuntimeError):
    """A distributed run that could not start or finish; the message names the process that is at fault."""


def _restored(kind: type[MarlSchedError], arguments: tuple[Any, ...], attributes: dict[str, Any]) -> MarlSchedError:
    error = kind.__new__(kind, *arguments)
    vars(error).update(attributes)
    return error


def require(what: str, name: str, known: Iterable[str]) -> str:
    """`name` if it is one of `known`, else UnknownNameError."""
    names = list(known)
    if name not in names:
        raise UnknownNameError(what, name, names)
    return name


def require_integer(what: str, value: Any, low: int, high: int, unit: str = "") -> int:
    """`value` as int if it is an integer of [low, high], NumPy's included, else InvalidOptionError."""
    if not isinstance(value, bool) and hasattr(value, "__index__") and low <= (number := operator.index(value)) <= high:
        return number
    of_unit = f" ({unit})" if unit else ""
    raise InvalidOptionError(f"{what}: expected an integer in [{low}, {high}]{of_unit}, got {_shorten(value)}")


def _shorten(value: object, limit: int = 60) -> str:
    # Python refuses to write integers of thousands of digits in decimal.
    text = hex(value) if isinstance(value, int) and value.bit_length() > 4 * limit else repr(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."

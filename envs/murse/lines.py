"""Lines of numbers in problem files of others; every complaint names the file and the line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marl_sched.envs.murse.instance import MurseInstance
from marl_sched.errors import InvalidFileError, InvalidOptionError


@dataclass(frozen=True)
class Line:
    """One line's words, and where it stands."""

    path: Path
    number: int
    words: tuple[str, ...]

    def fail(self, expected: str, got: object | None = None) -> InvalidFileError:
        """The complaint about this line."""
        return InvalidFileError(self.path, f"line {self.number}", expected, got)

    def numbers(self, what: str) -> list[float]:
        """All words as numbers >= 0; `what` describes the line."""
        values = []
        for word in self.words:
            try:
                value = float(word)
            except ValueError:
                raise self.fail(what, word) from None
            if not np.isfinite(value) or value < 0:
                raise self.fail(f"{what}, none of them negative", word)
            values.append(value)
        return values

    def integers(self, what: str) -> list[int]:
        """All words as integers >= 0; `what` describes the line."""
        values = self.numbers(what)
        for word, value in zip(self.words, values, strict=True):
            if value != int(value):
                raise self.fail(what, word)
        return [int(value) for value in values]

    def exactly(self, count: int, what: str) -> None:
        """Complain unless there are that many words."""
        if len(self.words) != count:
            raise self.fail(f"{count} columns ({what})", len(self.words))


def read_lines(path: Path) -> list[Line]:
    """The lines of an ASCII file that hold something, comments (#) left out."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InvalidFileError(path, "", f"a readable file ({error.strerror})") from error
    lines = []
    for number, content in enumerate(raw.splitlines(), start=1):
        if not content.isascii():
            raise InvalidFileError(path, f"line {number}", "ASCII text", content.decode("utf-8", "replace"))
        words = content.decode("ascii").partition("#")[0].split()
        if words:
            lines.append(Line(path, number, tuple(words)))
    return lines


def header(path: Path, lines: list[Line], columns: int, what: str) -> Line:
    """The first line, of at least that many columns; `what` describes it."""
    if not lines:
        raise InvalidFileError(path, "line 1", what, "an empty file")
    if len(lines[0].words) < columns:
        raise lines[0].fail(f"at least {columns} columns ({what})", len(lines[0].words))
    return lines[0]


def checked(path: Path, **values: object) -> MurseInstance:
    """The instance of these fields; InvalidFileError that names the file if it cannot be."""
    try:
        return MurseInstance(**values)  # type: ignore[arg-type]  # the callers' values, checked by the class itself
    except InvalidOptionError as error:
        raise InvalidFileError(path, "", f"a possible problem ({error})") from error

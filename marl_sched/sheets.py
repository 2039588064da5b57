"""Problems and records as spreadsheets: what a domain declares of its columns; marl_sched.sheet_reading reads them.

A sheet has headings in its first row and one node of the problem, such as an aircraft, in every other row. A row that
begins with `name:` holds a setting of the whole file, one that begins with `#` a remark. Fields are separated by
commas, semicolons or tabs; where semicolons separate them a comma may stand for the decimal point. All that is wrong in
a file is reported at once, each with row and column as the spreadsheet counts them.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from marl_sched.errors import InvalidSheetError

_AFTER_ALL_ROWS = 2**62
_FAMILY = " *"  # ends the name of a column that stands for many


@dataclass(frozen=True, kw_only=True)
class Cell:
    """What a cell holds: `read` makes a value of its text, or raises ValueError; `expected` says what it takes."""

    expected: str
    read: Callable[[str], Any]
    numeric: bool = False  # whether a comma may stand for the decimal point


def text() -> Cell:
    """A cell of any text but none."""
    return Cell(expected="a text", read=str)


def one_of(*words: str) -> Cell:
    """A cell of one of these words, in capitals or not."""

    def read(given: str) -> str:
        if given.casefold() not in words:
            raise ValueError
        return given.casefold()

    return Cell(expected=" or ".join(words), read=read)


def number(low: float, high: float = math.inf, *, unit: str = "", above: bool = False, whole: bool = False) -> Cell:
    """A cell of a finite number in [low, high], in (low, high] if `above`, an integer if `whole`."""
    kind = "an integer" if whole else "a number"
    upper = "" if high == math.inf else f" and <= {high:,.15g}"
    expected = f"{kind} {'>' if above else '>='} {low:,.15g}{upper}{f' ({unit})' if unit else ''}"

    def read(given: str) -> float | int:
        value = float(given)
        inside = (value > low if above else value >= low) and value <= high
        if not math.isfinite(value) or not inside or (whole and value != int(value)):
            raise ValueError
        return int(value) if whole else value

    return Cell(expected=expected, read=read, numeric=True)


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column: its heading, what its cells hold, and what that means.

    A name that ends in ` *` stands for any number of columns, `robot *` for `robot arm` and `robot cart`; a row's
    value is then a dict by what takes the place of the star. A cell that may be left `optional` is None.
    """

    name: str
    cell: Cell
    meaning: str
    optional: bool = False

    @property
    def family(self) -> bool:
        """Whether it stands for any number of columns."""
        return self.name.endswith(_FAMILY)

    def accepts(self, heading: str) -> bool:
        """Whether a heading is this column's; capitals and spaces do not matter."""
        plain, own = " ".join(heading.casefold().split()), self.name.casefold()
        return plain.startswith(own.removesuffix("*")) if self.family else plain == own

    def member(self, heading: str) -> str:
        """What takes the star's place in a heading of a family."""
        return " ".join(heading.split())[len(self.name) - 1 :]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A value that holds for the whole file: an option of `marl-sched import`, or a row that begins with `name:`.

    Attributes:
        default: its text where nobody gives it; None: none, and where it is `required` somebody has to.
        example: what the template has for it; "": nothing.
        template: the text of a file to begin with, where the setting is the name of one.
        changes: (instance, value) -> the instance with another value of this setting and the same noise, and
            `of` the value that an instance has: what `marl-sched advise --NAME +1` asks for; None: it cannot.
    """

    name: str
    cell: Cell
    meaning: str
    default: str | None = None
    required: bool = False
    example: str = ""
    template: Callable[[], str] | None = None
    of: Callable[[Any], int] | None = None
    changes: Callable[[Any, int], Any] | None = None


@dataclass(frozen=True)
class Row:
    """One row: its number in the spreadsheet, its values by column."""

    number: int
    values: Mapping[str, Any]

    def __getitem__(self, column: str) -> Any:
        """The value of a column; None where an optional cell is empty."""
        return self.values[column]


@dataclass
class Complaints:
    """What is wrong with a file."""

    path: str | Path
    noted: list[tuple[int, str]] = field(default_factory=list)  # (row, or a number beyond all rows; what it says)

    def add(self, row: int | None, column: str, expected: str, got: object = None) -> None:
        """Note that a cell, or with `row` None the file, does not hold what is expected."""
        place = ", ".join([*([f"row {row}"] if row is not None else []), *([f"column {column}"] if column else [])])
        tail = "" if got is None else f", got {got!r}"
        self.note(f"{self.path}: {place + ': ' if place else ''}expected {expected}{tail}", row)

    def note(self, sentence: str, row: int | None = None) -> None:
        """Note a whole sentence, of a row or of the file."""
        self.noted.append((_AFTER_ALL_ROWS if row is None else row, sentence))

    def settle(self) -> None:
        """InvalidSheetError if anything was noted, in the order of rows."""
        if self.noted:
            raise InvalidSheetError(self.path, [sentence for _, sentence in sorted(self.noted, key=lambda one: one[0])])


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """How something of a domain stands in a spreadsheet.

    Attributes:
        row: what a row holds, in the singular, such as "aircraft".
        columns: in the order of the template; `key` names the one whose values differ in all rows, None: there is none.
        examples: rows of the template, column's heading -> text.
        settings: what holds for the whole file.
        check: (rows, settings, complaints): note what single cells cannot show. Cells that are wrong are None there.
        build: (rows, settings) -> what a file without complaints means.
    """

    row: str
    columns: tuple[Column, ...]
    examples: tuple[Mapping[str, str], ...]
    check: Callable[[Sequence[Row], Mapping[str, Any], Complaints], None]
    build: Callable[[Sequence[Row], Mapping[str, Any]], Any]
    settings: tuple[Setting, ...] = ()
    key: str | None = None

    def template(self) -> str:
        """A CSV file to begin with: headings, examples, settings, and what every column means."""
        out = io.StringIO()
        headings = list(dict.fromkeys(heading for example in self.examples for heading in example))
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(headings)
        writer.writerows([example.get(heading, "") for heading in headings] for example in self.examples)
        writer.writerows([f"{one.name}:", one.example] for one in self.settings if one.example)
        for column in self.columns:
            optional = "; may be left empty" if column.optional else ""
            writer.writerow([f"# {column.name}: {column.meaning}; {column.cell.expected}{optional}"])
        return out.getvalue()

"""Reading a spreadsheet (marl_sched.sheets) from CSV, with everything that is wrong in it at once."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError
from marl_sched.sheets import Column, Complaints, Row, Sheet

_DELIMITERS = ",;\t"


def read_sheet(sheet: Sheet, path: str | Path, given: Mapping[str, str] | None = None) -> Any:
    """What a CSV file means; `given` are texts of settings, which go before those of the file.

    Raises InvalidSheetError with everything that is wrong in the file, InvalidFileError for one that is no table,
    UnknownNameError or InvalidOptionError for a given setting.
    """
    settings = read_settings(sheet, given or {})
    reading = _Reading(sheet, Path(path), settings)
    reading.take_headings()
    reading.complaints.settle()  # without its columns no cell of a file can be told
    reading.take_rows()
    filled = {one.name: None if one.default is None else one.cell.read(one.default) for one in sheet.settings}
    values = {**filled, **reading.settings}
    sheet.check(reading.rows, values, reading.complaints)
    reading.complaints.settle()
    return sheet.build(reading.rows, values)


def read_settings(sheet: Sheet, given: Mapping[str, str]) -> dict[str, Any]:
    """The values of settings by their texts; UnknownNameError or InvalidOptionError for a wrong one."""
    known = {one.name: one for one in sheet.settings}
    values = {}
    for name, words in given.items():
        if name not in known:
            raise UnknownNameError(f"setting of a sheet of {sheet.row}", name, known)
        try:
            values[name] = known[name].cell.read(words)
        except InvalidFileError:  # the setting names a file, which says itself what is wrong with it
            raise
        except ValueError as error:
            raise InvalidOptionError(f"--{name}: expected {known[name].cell.expected}, got {words!r}") from error
    return values


def has_headings(sheet: Sheet, path: str | Path) -> bool:
    """Whether a file has the headings that every file of a sheet has; InvalidFileError for one that is no table."""
    headings = _records(Path(path))[0][0]
    return all(any(column.accepts(heading) for heading in headings) for column in sheet.columns if not column.optional)


class _Reading:
    """One file on its way from texts to rows."""

    def __init__(self, sheet: Sheet, path: Path, settings: dict[str, Any]) -> None:
        self.sheet, self.settings, self.complaints = sheet, settings, Complaints(path)
        records, self._comma = _records(path)
        self._headings, self._records = records[0], records[1:]
        self._columns: list[Column] = []
        self._in_file: set[str] = set()
        self.rows: list[Row] = []

    def take_headings(self) -> None:
        """Find the column of each heading; empty headings end the table."""
        while self._headings and not self._headings[-1]:
            self._headings.pop()
        known = [column.name for column in self.sheet.columns]
        for place, heading in enumerate(self._headings, start=1):
            column = next((one for one in self.sheet.columns if one.accepts(heading)), None)
            if column is None:
                close = get_close_matches(heading.casefold(), known, n=1)
                hint = f" (did you mean {close[0]}?)" if close else ""
                self.complaints.add(1, str(place), f"one of the headings {', '.join(known)}{hint}", heading)
                continue
            if self._headings.index(heading) < place - 1 or (not column.family and column in self._columns):
                self.complaints.add(1, heading, "every heading once", heading)
            self._columns.append(column)
        for column in self.sheet.columns:
            if not column.optional and column not in self._columns:
                self.complaints.add(1, "", f"a column {column.name}")

    def take_rows(self) -> None:
        """Read every row and setting, and see that none is missing or there twice."""
        for count, record in enumerate(self._records, start=2):
            if not any(record) or record[0].startswith("#"):
                continue
            if record[0].endswith(":"):
                self._take_setting(count, record)
            else:
                self.rows.append(self._row(count, record))
        for one in self.sheet.settings:
            if one.required and one.name not in self.settings and one.name not in self._in_file:
                what = f"the setting {one.name}, given by --{one.name} or in a row that begins with {one.name}:"
                self.complaints.add(None, "", what)
        if not self.rows:
            self.complaints.add(None, "", f"a row for each {self.sheet.row}")
        first: dict[Any, int] = {}
        for row in self.rows if self.sheet.key else ():
            value = row[str(self.sheet.key)]
            if value is not None and first.setdefault(value, row.number) != row.number:
                expected = f"another one than in row {first[value]}"
                self.complaints.add(row.number, str(self.sheet.key), expected, value)

    def _take_setting(self, count: int, record: Sequence[str]) -> None:
        name = record[0].removesuffix(":").casefold()
        known = {one.name: one for one in self.sheet.settings}
        if name not in known:
            self.complaints.add(count, "", f"one of the settings {', '.join(known) or 'none'}", record[0])
            return
        if name in self._in_file:
            self.complaints.add(count, "", "every setting once", record[0])
        self._in_file.add(name)
        words = record[1] if len(record) > 1 else ""
        try:
            value = known[name].cell.read(words)
        except InvalidFileError as error:
            self.complaints.note(str(error), count)
            return
        except ValueError:
            self.complaints.add(count, name, known[name].cell.expected, words)
            return
        self.settings.setdefault(name, value)

    def _row(self, count: int, record: Sequence[str]) -> Row:
        values: dict[str, Any] = {one.name: {} if one.family else None for one in self.sheet.columns}
        for place in range(len(self._headings), len(record)):
            if record[place]:
                self.complaints.add(count, str(place + 1), "nothing, as the column has no heading", record[place])
        for place, (column, heading) in enumerate(zip(self._columns, self._headings, strict=True)):
            value = self._value(count, column, heading, record[place] if place < len(record) else "")
            if column.family:
                values[column.name][column.member(heading)] = value
            else:
                values[column.name] = value
        return Row(count, values)

    def _value(self, count: int, column: Column, heading: str, words: str) -> Any:
        """A cell's value; None, and a complaint unless it may be empty, where it has none."""
        if not words and column.optional:
            return None
        decimal = words.replace(",", ".") if self._comma and column.cell.numeric and words.count(",") == 1 else words
        try:
            if not words:
                raise ValueError
            return column.cell.read(decimal)
        except ValueError:
            self.complaints.add(count, heading, column.cell.expected, words)
            return None


def _records(path: Path) -> tuple[list[list[str]], bool]:
    """The rows of a CSV file, texts without spaces around them, the heading first; whether semicolons part them.

    The separator is the one that the first row has most of.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InvalidFileError(path, "", f"a readable file ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InvalidFileError(path, f"byte {error.start}", "UTF-8 text (save the sheet as CSV UTF-8)") from error
    first = text.partition("\n")[0]
    delimiter = max(_DELIMITERS, key=first.count)
    try:
        lines = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        records = [[cell.strip() for cell in record] for record in lines]
    except csv.Error as error:
        raise InvalidFileError(path, f"line {lines.line_num}", f"CSV ({error})") from error
    if not records or not any(records[0]):
        raise InvalidFileError(path, "row 1", "the headings of the columns")
    return records, delimiter == ";"

"""Plain data into msgspec structs, with errors that name file, field, what was expected and what was found.

A field says what it expects in the description of its type:

    class Plane(Struct, forbid_unknown_fields=True):
        income: Annotated[float, Meta(gt=0, description="a number > 0 (per flying hour)")]

    convert(data, Plane, "fleet.json")      # fleet.json: income: expected a number > 0 (per flying hour), got -3.0
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from marl_sched.errors import InvalidFileError

T = TypeVar("T")
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]")
_WRONG_FIELD = re.compile(r"Object (missing required|contains unknown) field `(.*)`")


def convert(data: Any, kind: type[T], where: str | Path) -> T:
    """`data` as a `kind`; InvalidFileError names `where`, the field, what was expected there and what was found."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        message, _, tail = str(error).partition(" - at `")
        raise _refusal(data, kind, where, message, tail.rstrip("`").removeprefix("$")) from error
    except OverflowError as error:  # an integer beyond the range of floats
        raise InvalidFileError(where, "", f"numbers within the range of floats ({error})") from error


def _refusal(data: Any, kind: type, where: str | Path, message: str, tail: str) -> InvalidFileError:
    """The error for msgspec's message about the place `tail`, such as `.planes[1].income`."""
    steps: list[str | int] = [name or (int(index) if index.isdigit() else index) for name, index in _STEP.findall(tail)]
    found = _WRONG_FIELD.match(message)
    if found is None:
        place, expected = _expected(kind, steps, message)
        return InvalidFileError(where, _as_text(place), expected, _Shown(_value(data, place)))
    which, name = found.groups()
    if which == "contains unknown":
        known = ", ".join(_fields(_at(kind, steps)[-1][0])) or "no field"
        return InvalidFileError(where, _as_text([*steps, name]), f"one of {known}", name)
    place, expected = _expected(kind, [*steps, name], "a value")
    return InvalidFileError(where, _as_text([*steps, name]), f"{expected}; the field is missing")


class _Shown:
    """A value as an error shows it, None included."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __repr__(self) -> str:
        return repr(self._value)


def _expected(kind: type, steps: list[str | int], message: str) -> tuple[list[str | int], str]:
    """The innermost place in its object that says what it expects, and what that is; else msgspec's own words."""
    way = _at(kind, steps)
    if isinstance(way[-1][0], inspect.StructType):
        return steps, way[-1][1] or "an object"
    for depth in range(len(way) - 1, -1, -1):
        if isinstance(way[depth][0], inspect.StructType):
            break
        if way[depth][1]:
            return steps[:depth], way[depth][1]
    return steps, message.removeprefix("Expected ").partition(", got ")[0].replace("`", "")


def _at(kind: type, steps: list[str | int]) -> list[tuple[inspect.Type, str]]:
    """The types on the way along `steps`, the whole first, each with its description or ""."""
    here = _plain(inspect.type_info(kind))
    way = [here]
    for step in steps:
        inner = _inner(here[0], step)
        if inner is None:
            break
        here = _plain(inner)
        way.append(here)
    return way


def _plain(info: inspect.Type) -> tuple[inspect.Type, str]:
    """A type without its metadata, and the description in it."""
    described = ""
    while isinstance(info, inspect.Metadata):
        described = described or str((info.extra_json_schema or {}).get("description", ""))
        info = info.type
    if isinstance(info, inspect.UnionType):  # a field that may be missing: what matters is the other member
        members = [member for member in info.types if not isinstance(member, inspect.NoneType)]
        if len(members) == 1:
            inner, words = _plain(members[0])
            return inner, described or words
    return info, described


def _inner(info: inspect.Type, step: str | int) -> inspect.Type | None:
    if isinstance(info, inspect.StructType):
        return next((field.type for field in info.fields if field.encode_name == step), None)
    if isinstance(info, inspect.ListType | inspect.VarTupleType):
        return info.item_type
    if isinstance(info, inspect.TupleType) and isinstance(step, int):
        return info.item_types[step] if step < len(info.item_types) else None
    return None


def _fields(info: inspect.Type) -> list[str]:
    return [field.encode_name for field in info.fields] if isinstance(info, inspect.StructType) else []


def _value(data: Any, steps: list[str | int]) -> Any:
    for step in steps:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):  # msgspec does not say which key of a mapping it means
            return data
    return data


def _as_text(steps: list[str | int]) -> str:
    return "".join(f"[{step}]" if isinstance(step, int) or step == "..." else f".{step}" for step in steps).lstrip(".")

"""Reading and writing files: JSON in with errors that name file and field, everything out whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from marl_sched.errors import InvalidFileError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends well, and vanishes otherwise."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` as indented JSON, beside and renamed."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """The JSON value in a file; InvalidFileError says where it is malformed or why it cannot be read.

    NaN and Infinity, which are not JSON, are refused, and so is a key that an object has twice.
    """
    path = Path(path)

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is none of its numbers")

    def as_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        known: dict[str, Any] = {}
        for key, value in pairs:
            if key in known:
                raise InvalidFileError(path, key, "a key that its object has once", (known[key], value))
            known[key] = value
        return known

    try:
        return json.loads(path.read_bytes(), parse_constant=refuse, object_pairs_hook=as_object)
    except InvalidFileError:
        raise
    except OSError as error:
        raise InvalidFileError(path, "", f"a readable file ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InvalidFileError(path, f"byte {error.start}", "UTF-8 text") from error
    except json.JSONDecodeError as error:
        where = f"line {error.lineno} column {error.colno}"
        raise InvalidFileError(path, where, f"valid JSON ({error.msg})") from error
    except RecursionError as error:
        raise InvalidFileError(path, "", "JSON that is not nested so deeply") from error
    except ValueError as error:  # a constant, or an integer of thousands of digits, which Python does not read
        raise InvalidFileError(path, "", f"valid JSON ({error})") from error

"""Reading and writing files: JSON in with errors that name file and field, everything out whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from marl_sched.errors import InvalidFileError

STDOUT = Path("-")
"""The path that stands for standard output."""
_OPEN_FILE = re.compile(r"/dev/(stdout|stderr)|(?:/dev|/proc/self)/fd/(\d+)")
_STANDARD = {"stdout": 1, "stderr": 2}


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path that takes the place of the file `path` when the block ends well, and vanishes otherwise.

    The file appears whole or not at all, with the permissions it had. A link stays, and what it leads to is replaced.
    What is no plain file (a device, a pipe) and what lies in /dev or /proc, which may be somebody's open file, is
    written through instead. Raises OSError with the name of the file, where the disk is full too.
    """
    path = Path(path)
    through = _is_written_through(path)
    target = path if through else path.resolve()
    if not through:
        target.parent.mkdir(parents=True, exist_ok=True)
    folder = None if through else target.parent
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=folder)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        if through:
            _append(temporary, path)
        else:
            temporary.chmod(_permissions(target))
            temporary.replace(target)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def _is_written_through(path: Path) -> bool:
    if path.absolute().parts[1:2] in (("dev",), ("proc",)):
        return True
    return path.exists() and not path.is_file() and not path.is_dir()


def _permissions(target: Path) -> int:
    """Those that the file has, or that the umask grants to a new one."""
    if target.exists():
        return stat.S_IMODE(target.stat().st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def _append(source: Path, path: Path) -> None:
    """Write a file's bytes to a device or pipe, or to what this process has open under that name."""
    named = _OPEN_FILE.fullmatch(str(path))
    if named:
        sys.stdout.flush()
        sys.stderr.flush()
    # Another opening of an open file would have a position of its own, and the two would overwrite each other.
    opened = os.dup(_STANDARD.get(named[1]) or int(named[2])) if named else path
    with source.open("rb") as file, open(opened, "ab") as out:
        shutil.copyfileobj(file, out)


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` as indented JSON, whole or not at all; the path `-` is standard output."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    if Path(path) == STDOUT:
        sys.stdout.write(text)
        sys.stdout.flush()
        return
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


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
